"""The place where `NumpyPolicy` stood first; it is `cassie_mjx.NumpyPolicy`."""

from cassie_mjx.agents.numpy_policy import NumpyPolicy as NumpyPolicy

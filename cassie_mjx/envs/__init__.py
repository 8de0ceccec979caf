"""The walking task: the Markov decision process of Xie et al. 2018, written once for both physics engines."""

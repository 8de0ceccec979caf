"""Cassie MJX: a massively parallel training pipeline for the Cassie biped, on MJX and on MuJoCo C."""

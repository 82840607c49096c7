"""The experiments of the COMBREL paper (Fachantidis et al. 2015, Section 5), with controls: ``sb3-combrel reproduce``."""

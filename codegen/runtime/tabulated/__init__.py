"""Tables in kernels: splines through numbers that stand behind the parameters."""

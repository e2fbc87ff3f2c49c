"""From a program to the text of a module: derivatives, kernels as strings, templates, verification of the text."""

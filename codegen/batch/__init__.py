"""Sweeps, which are many solves of one problem: their cases, executors and stores."""

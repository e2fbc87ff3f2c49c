"""Many solves: cases, executors, stores."""

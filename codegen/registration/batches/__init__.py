"""Many registrations: the pairs of a folder or of a table, shared between processes, whatever becomes of each."""

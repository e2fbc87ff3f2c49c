"""What solving returns: results with residuals evaluated anew, as objects, tables, JSON and archives."""

"""Results of solves, with residuals that are evaluated outside the driver: objects, tables, JSON and archives."""

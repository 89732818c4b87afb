"""What an estimator remembers between samples: one table of fields, and the record made from it."""

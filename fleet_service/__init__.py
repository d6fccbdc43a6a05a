"""The fleet service: many vehicles' evidence in, one map of grip out."""

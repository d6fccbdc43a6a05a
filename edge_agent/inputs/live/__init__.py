"""Live sources: threads that listen, and rows built from their messages at a fixed rate."""

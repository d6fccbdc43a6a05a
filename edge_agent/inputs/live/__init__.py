"""Live sources: threads that receive messages, and rows built from the messages at a fixed rate."""

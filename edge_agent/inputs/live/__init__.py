"""Live sources: threads that listen, and rows at a fixed rate of what they heard."""

"""Examples to start from; the tests run every one of them."""

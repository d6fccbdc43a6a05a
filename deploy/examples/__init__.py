"""Examples to start from; the tests run all of them."""

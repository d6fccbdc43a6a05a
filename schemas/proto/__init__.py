"""Wire messages: gripmap.proto and the module generated from it (`make proto`)."""

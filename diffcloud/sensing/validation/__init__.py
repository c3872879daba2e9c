"""What is wrong with a raw episode, fault by fault."""

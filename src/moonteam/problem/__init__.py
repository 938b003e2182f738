"""What is to be done: scenarios and missions, read from files and checked."""

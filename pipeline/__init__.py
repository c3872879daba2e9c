"""Commands: read, call one core function, write. No mathematics here."""

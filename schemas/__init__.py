"""What crosses a process boundary or is read from a file: messages, descriptions, keys, logs."""

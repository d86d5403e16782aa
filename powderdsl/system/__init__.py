"""What is asked of the operating system: files, archives, processes, signals."""

"""Access to the operating system: files, archives, processes, signals."""

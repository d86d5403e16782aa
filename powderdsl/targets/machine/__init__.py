"""One low-level program for processors and for WebAssembly."""

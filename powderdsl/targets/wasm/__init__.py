"""The target WebAssembly: bytes directly from schedules, for any machine with an engine."""

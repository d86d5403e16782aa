"""The commands, one module each: `powderdsl NAME` is `NAME.py`."""

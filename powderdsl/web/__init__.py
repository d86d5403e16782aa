"""The playground: a page where people paint worlds, run them and rewrite their rules. `powderdsl play`."""

"""Backends: each turns a program into something that runs. A new one is a module and a row in `registry`."""

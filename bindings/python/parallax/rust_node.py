"""Runs a node of Rust, or the recorder, as a process of its own: the native module alone, without JAX or numpy.

Its arguments are the path of that module and those of the launcher.
"""

import sys
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_file_location

if __name__ == "__main__":
    path, *arguments = sys.argv[1:]
    loader = ExtensionFileLoader("parallax._native", path)
    spec = spec_from_file_location("parallax._native", path, loader=loader)
    assert spec is not None
    native = module_from_spec(spec)
    loader.exec_module(native)
    sys.exit(0 if native.work(arguments, None) else 1)

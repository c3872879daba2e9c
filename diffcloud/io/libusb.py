"""Load libusb-1.0 for packages whose wheels link to it, on systems that lack it."""

from __future__ import annotations

import ctypes


def load_libusb() -> None:
    """Load the library of libusb-package. Modules imported afterwards that link to libusb-1.0 then find it.

    Raises:
        ImportError, OSError: the package is missing, or its library cannot be loaded.
    """
    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), ctypes.RTLD_GLOBAL)

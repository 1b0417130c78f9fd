"""Suffixes of files by format; imports nothing, because the command line checks them before it loads a format."""

HDF5_SUFFIXES = (".h5", ".hdf5", ".nxs")
"""Suffixes of HDF5 files."""

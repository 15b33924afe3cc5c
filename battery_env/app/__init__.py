"""The application over the library: one discharge, many of them, and the command line."""

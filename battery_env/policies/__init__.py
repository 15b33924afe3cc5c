"""Policies as estimators of recorded cells: with torch or as ONNX files, and those that come with the package."""

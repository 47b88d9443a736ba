"""Dataclasses to json and back: values, forms, files of their own, and json schemas."""

"""Dataclasses to json and back: values, files, forms and json schemas."""

"""The codec of compact files: whole numbers to bytes and back, by integer arithmetic alone.

docs/compact-file.md defines the bytes. Every reader of the format decodes the same whole numbers.
"""

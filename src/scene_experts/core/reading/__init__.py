"""The one way in for files that other programs wrote.

A reader opens its file with `source.opening`, which enforces the format's `budget.Budget` and turns
every failure into one `InputError`. The other modules read what files contain: JSON and literals
(`plain`), zip archives (`archives`), pictures (`pictures`), tables of vertices (`vertices`) and
named tensors (`tensors`). Numbers leave this package finite and in range (`numbers`). A test checks
that no reader opens files in any other way. See docs/security.md.
"""

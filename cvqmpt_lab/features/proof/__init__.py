"""A proof of a certified motion that others check, without this toolkit.

`claims` states what the proof is about; `planes` finds the planes between bodies; `write_proof`
writes the file. `cvqmpt_check` is the checker: one file that needs numpy alone and runs wherever it
is copied.

Command: ``cvqmpt certify MOTION --proof p.json``. Extra: none. Page: docs/proof.md.
"""

"""Problems on which moving horizon estimation is worth its QPs, or is not: one folder each.

`problem` says what is estimated from which records, `baselines` with what it is compared, `report`
makes table and picture, and `command` is what ``python -m examples.gallery.NAME`` runs.
"""

"""Old place of the functions of `qpmhe.models.loading` on users' files."""

from ..models.loading import fingerprint, imported, module_file

__all__ = ["fingerprint", "imported", "module_file"]

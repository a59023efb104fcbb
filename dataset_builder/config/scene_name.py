"""Scene names from the names of scene files: ``IfcReinforcingBar.ifc`` becomes ``ifcreinforcingbar``."""

from __future__ import annotations

import re
import unicodedata
from pathlib import Path


def scene_name_of(path: Path) -> str:
    """Return the scene name that a file name gives: lower case, with hyphens for all but letters and digits.

    Accents are removed, and letters without an ASCII form are left out; the name may be empty or reserved.
    """
    letters = unicodedata.normalize("NFKD", path.stem).casefold()
    plain = "".join(character for character in letters if not unicodedata.combining(character))
    return re.sub("[^a-z0-9]+", "-", plain).strip("-")

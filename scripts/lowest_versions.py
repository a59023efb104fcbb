"""Print the lowest versions of the base package's dependencies that pyproject.toml allows, as constraints of pip.

python scripts/lowest_versions.py
"""

import re
import tomllib
from pathlib import Path

PROJECT = Path(__file__).parents[1] / "pyproject.toml"

for requirement in tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]["dependencies"]:
    print(re.sub(r">=([^,]+).*", r"==\1", requirement))

"""The data in the pages of replays."""

import json
import re
from pathlib import Path
from typing import Any


def page_data(file: Path) -> Any:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', file.read_text("utf-8"), re.S)
    assert found is not None
    return json.loads(found[1])

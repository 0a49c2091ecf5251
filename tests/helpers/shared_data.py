# This source code is licensed under the MIT license found in the LICENSE file.
"""Where recordings and human demonstrations lie that the package never ships; tests that need them skip without."""

import os
from pathlib import Path

SHARED = Path(os.environ.get("KOAP_SHARED", Path(__file__).parents[3] / "shared"))
HUMAN = SHARED / "d3il_avoiding_human"

"""Put this folder's helper module on the path: test folders carry no `__init__.py`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

"""Speed of the twin, see `benchmarks/twin_speed.py`: python benchmarks/twin.py [--repeats 7] [--sets 500]"""

import sys
from pathlib import Path

from benchmarks.twin_speed import main

sys.path[0] = str(Path(__file__).resolve().parent.parent)  # else `import twin` would find this file


if __name__ == "__main__":
    main()

"""What a finished run says of demonstrations that come later; nothing is trained.

python examples/score_new_data.py RUN_DIR FILE     # a file of ours, or what `oodil demos convert` reads
"""

import sys

import oodil

scored = oodil.score(sys.argv[1], sys.argv[2])
found = scored.found["transferability"]
for row, verdict in zip(found.table(), found.verdicts, strict=True):
    print(f"demonstration {row['demonstration']:>3}: transferability {row['transferability']:.3f}, {verdict}")

"""Commands: read, call one core function, write. No mathematics here."""

import os

# A step is a chain of small operations: a second thread gains nothing (measured), and beside another busy process its
# spinning costs tenfold. Also, sums in several threads may end in other last bits. OpenBLAS and OpenMP read this when numpy
# and torch are imported, so it stands before every import.
os.environ.setdefault("OMP_NUM_THREADS", "1")

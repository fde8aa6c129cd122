"""lxml's side of benches/esi.rs: for each path on stdin, the nanoseconds it takes to build the file's tree."""

import sys
import time

from lxml import etree

print("lxml", ".".join(map(str, etree.LXML_VERSION)), "libxml2", ".".join(map(str, etree.LIBXML_VERSION)), flush=True)
for line in sys.stdin:
    path = line.rstrip("\n")
    start = time.perf_counter_ns()
    tree = etree.parse(path)
    print(time.perf_counter_ns() - start, flush=True)
    del tree

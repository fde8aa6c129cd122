"""The lxml part of benches/esi.rs. For each path on stdin, prints the time to build the file's tree in ns:
wall-clock time and processor time."""

import sys
import time

from lxml import etree

print("lxml", ".".join(map(str, etree.LXML_VERSION)), "libxml2", ".".join(map(str, etree.LIBXML_VERSION)), flush=True)
for line in sys.stdin:
    path = line.rstrip("\n")
    start, busy = time.perf_counter_ns(), time.process_time_ns()
    tree = etree.parse(path)
    busy = time.process_time_ns() - busy
    print(time.perf_counter_ns() - start, busy, flush=True)
    del tree

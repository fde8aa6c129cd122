#!/usr/bin/env python3
"""KickCAT as redundant MainDevice: kickcat_ring.py NIC SECOND

Leads all devices to Op and prints how many they are. Then it exchanges process data for as many seconds as a line of
the input says, and prints the result as JSON.
"""

import json
import select
import sys
import time

import kickcat

PERIOD = 0.001
TIMEOUT = 0.02


def main():
    link = kickcat.create_link(sys.argv[1], sys.argv[2])
    link.set_timeout(TIMEOUT)
    bus = kickcat.Bus(link)
    bus.init(1.0)
    devices = bus.slaves()
    bus.create_mapping()
    bus.request_state(kickcat.State.SAFE_OP)
    bus.wait_for_state(kickcat.State.SAFE_OP, 10.0)
    for device in devices:
        device.set_output_bytes(bytes(device.output_size))
    exchange = bus.process_data_no_check
    exchange()
    bus.request_state(kickcat.State.OPERATIONAL)
    bus.wait_for_state(kickcat.State.OPERATIONAL, 10.0, exchange)
    print(f"Op {len(devices)}", flush=True)
    while not select.select([sys.stdin], [], [], PERIOD)[0]:
        exchange()
    end = time.monotonic() + float(sys.stdin.readline())
    good, bad = 0, {}
    while time.monotonic() < end:
        try:
            bus.process_data()
            good += 1
        except Exception as error:
            bad[str(error)] = bad.get(str(error), 0) + 1
        time.sleep(PERIOD)
    states = [bus.get_state(device).name for device in devices]
    print(json.dumps({"good": good, "bad": sum(bad.values()), "errors": bad, "states": states}), flush=True)


if __name__ == "__main__":
    main()

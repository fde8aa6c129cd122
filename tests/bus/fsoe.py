"""An FSoE master of another vendor (PyPI `fsoe-master`) between two pipes.

Each message on stdin is the safety PDU in the device's outputs, once per bus cycle. Each answer on stdout is the PDU for
the device's inputs, the number of errors, the number of checked answers, and 1 in the state Data.
"""

import struct
import sys

import fsoe_master.fsoe_master as fsoe

PDU = struct.Struct("<BHHH")
ANSWER = struct.Struct("<7sHIB")
DATA, FAIL_SAFE = 0x36, 0x08
# Answers with fail-safe data before the outputs become valid.
FAIL_SAFE_ANSWERS = 20


class Watchdog:
    """The library's watchdog is a thread on the clock of the computer; this one counts bus cycles."""

    def __init__(self, timeout_s, callback):
        self.cycles = round(timeout_s * 1000)
        self.callback = callback
        self.active = False
        self.count = 0

    def cycle(self):
        self.count += 1
        if self.active and self.count > self.cycles:
            self.active = False
            self.callback()

    def reset(self):
        self.count = 0

    def activate(self):
        self.active, self.count = True, 0

    activate_and_reset = activate

    def deactivate(self):
        self.active = False

    stop = deactivate

    def start(self):
        pass

    def is_alive(self):
        return False


def main():
    connection, address, cycles = (int(argument, 0) for argument in sys.argv[1:])
    fsoe.Watchdog = Watchdog
    word = fsoe.DataType.UINT16
    output = fsoe.DictionaryItemOutput(key=1, name="output", data_type=word)
    input_ = fsoe.DictionaryItemInput(key=2, name="input", data_type=word, fail_safe_value=0)
    errors = []

    def report(transition, text):
        errors.append(transition)
        print(f"{transition}: {text}", file=sys.stderr, flush=True)

    master = fsoe.MasterHandler(
        dictionary=fsoe.Dictionary([output, input_]),
        slave_address=address,
        connection_id=connection,
        watchdog_timeout_s=cycles / 1000,
        application_parameters=[],
        report_error_callback=report,
    )
    master.master.dictionary_map.add(output)
    master.slave.dictionary_map.add(input_)
    master.start()
    checked, reply = 0, bytes(PDU.size)
    while pdu := sys.stdin.buffer.read(PDU.size):
        if not errors:
            master._watchdog.cycle()
        if pdu != reply and not errors:
            reply = pdu
            sent = PDU.unpack(master.get_request())
            master.set_reply(reply)
            if master.state is fsoe.StateData and sent[0] in (DATA, FAIL_SAFE):
                checked += 1
                answer = PDU.unpack(reply)[1]
                if answer != (sent[1] + 1) & 0xFFFF or input_.get() != answer:
                    report("DATA", f"{sent} -> {answer}, {input_.get()}")
                master.set_fail_safe(checked < FAIL_SAFE_ANSWERS)
                output.set(checked * 7 & 0xFFFF)
        in_data = master.state is fsoe.StateData
        sys.stdout.buffer.write(ANSWER.pack(master.get_request(), len(errors), checked, in_data))
        sys.stdout.buffer.flush()


main()

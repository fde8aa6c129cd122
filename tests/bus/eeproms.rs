//! EEPROMs that are read ahead of ethercrab's scan: its reads are answered from them, except where only
//! the device knows the answer.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use ecaxis_ecat::registers::{EEPROM_CONFIGURATION, EEPROM_CONTROL};
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::link::{Link, LinkError, MAX_FRAME, Nanos};
use ecaxis_master::session::{Options, Progress, run_on, run_on_link, simulated_bus};
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::recordings::{Datagram, FPRD, FPWR, Frame, datagrams};
use ecaxis_test_support::{Heard, assert_contains, faults, recorded, run, virtual_time};

/// Vendor, product, revision and serial number.
const IDENTITY: std::ops::Range<u16> = 0x08..0x10;

/// A device without a mailbox, and two drives.
fn machine() -> String {
    let mut text = "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n\
         [[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 0\n"
        .to_owned();
    for (position, name) in [(1, "x"), (2, "y")] {
        let _ = write!(
            text,
            "[[device]]\nname = \"{name}\"\nesi = \"esi/EPOS4.xml\"\nposition = {position}\nmode = \"csp\"\n\
             [device.axis]\nunit = \"turn\"\nencoder = 2000\n\
             limits = {{ velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }}\n"
        );
    }
    text
}

/// What a run has read from EEPROMs: how often each word address, by station; its steps, by name, with
/// begin and end in ns; its error.
struct Scan {
    reads: BTreeMap<(u16, u16), usize>,
    steps: BTreeMap<&'static str, (u64, u64)>,
    error: Option<String>,
}

impl Scan {
    /// Returns the number of reads of a station, without the identity.
    fn of(&self, station: u16) -> Vec<usize> {
        let of = self.reads.iter().filter(|((at, _), _)| *at == station);
        let without = of.filter(|((_, word), _)| !IDENTITY.contains(word));
        without.map(|(_, count)| *count).collect()
    }
}

fn scan(bench: &Bench, text: &str, options: Options) -> Scan {
    let mut machine = bench.machine(text);
    (machine.enable, machine.steps) = (false, Vec::new());
    let (mut options, recording) = recorded(options, bench.path());
    options.limit = Some(20_000_000);
    let (outcome, heard) = run(machine, options);
    let mut reads = BTreeMap::new();
    for datagram in datagrams(&recording) {
        let to_interface = (datagram.command, datagram.register()) == (FPWR, EEPROM_CONTROL);
        if let (true, true, [_, _, a0, a1, ..]) = (datagram.sent, to_interface, &datagram.data[..])
        {
            let word = u16::from_le_bytes([*a0, *a1]);
            *reads.entry((datagram.station(), word)).or_default() += 1;
        }
    }
    let steps = heard.0.into_iter().filter_map(|progress| match progress {
        Progress::BringUpTimes(steps) => Some(steps),
        _ => None,
    });
    let steps = steps.flatten();
    Scan {
        reads,
        steps: steps
            .map(|step| (step.name, (step.began_ns, step.began_ns + step.took_ns)))
            .collect(),
        error: outcome.result.err().map(|error| error.to_string()),
    }
}

/// ethercrab searches the categories from the first one on, four times, and reads texts byte by byte.
/// None of its reads reaches a device: each word is read once, the identity once more after the scan.
#[test]
fn no_read_of_ethercrab_reaches_a_device() {
    let bench = Bench::new();
    let scan = scan(&bench, &machine(), virtual_time());
    assert_eq!(scan.error, None);
    for station in 0x1000..0x1003 {
        let counts = scan.of(station);
        assert!(counts.len() > 4, "0x{station:04x}: {counts:?}");
        assert!(counts.iter().all(|count| *count == 1), "{:?}", scan.reads);
        assert_eq!(scan.reads.get(&(station, IDENTITY.start)), Some(&2));
    }
}

/// A bus on which 0x0502 of one station reports a wrong checksum. Counts the reads of that EEPROM.
#[derive(Debug)]
struct WrongChecksum {
    bus: SimLink,
    station: u16,
    reads: Arc<AtomicUsize>,
}

impl Link for WrongChecksum {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        let to_interface = |d: &&Datagram| {
            d.command == FPWR && d.station() == self.station && d.register() == EEPROM_CONTROL
        };
        let datagrams = Frame::parse(frame).datagrams;
        let reads = datagrams.iter().filter(to_interface);
        self.reads.fetch_add(reads.count(), Ordering::Relaxed);
        self.bus.send(frame)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        let Some(len) = self.bus.recv(buf)? else {
            return Ok(None);
        };
        let mut at = 16;
        for datagram in Frame::parse(&buf[..len]).datagrams {
            if datagram.command == FPRD
                && datagram.station() == self.station
                && datagram.register() == EEPROM_CONTROL
            {
                // Bit 11.
                buf[at + 11] |= 0x08;
            }
            at += 12 + datagram.data.len();
        }
        Ok(Some(len))
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.bus.next_arrival()
    }
}

/// Runs the machine on a link of its own.
fn run_on_link_of(link: impl FnOnce(SimLink) -> Box<dyn Link>) -> Result<(), String> {
    let bench = Bench::new();
    let mut machine = bench.machine(&machine());
    (machine.enable, machine.steps) = (false, Vec::new());
    let mut options = virtual_time();
    options.limit = Some(20_000_000);
    options.clock.enter();
    let bus = simulated_bus(&machine, 1, None, None).expect("a bus");
    let link = link(SimLink::new(bus));
    let mut heard = Heard::default();
    let outcome = run_on(link, machine, options, Arc::default(), &mut heard);
    outcome.result.map_err(|error| error.to_string())
}

/// ETG.1000.4: an error of the interface stays in 0x0502. Then the device itself answers ethercrab.
#[test]
fn eeprom_with_an_error_is_left_to_the_device() {
    let count = |station| {
        let reads = Arc::default();
        let link = |bus| {
            let reads = Arc::clone(&reads);
            Box::new(WrongChecksum {
                bus,
                station,
                reads,
            }) as Box<dyn Link>
        };
        assert_eq!(run_on_link_of(link), Ok(()));
        reads.load(Ordering::Relaxed)
    };
    let (without, with) = (count(0x1003), count(0x1002));
    assert_eq!(without, 0, "no such station");
    assert!(with > 50, "{with}");
}

/// A device may be exchanged, or its EEPROM be written, between the read and the scan.
#[test]
fn eeprom_that_changes_during_the_scan_is_an_error() {
    let bench = Bench::new();
    let well = scan(&bench, &machine(), virtual_time());
    let (began, ended) = well.steps["scan, PreOp"];
    let (_, read) = well.steps["EEPROMs"];
    assert!(began <= read && read < ended, "{:?}", well.steps);
    let at = read + (ended - read) / 2;
    let fault = format!(
        "[[fault]]\nkind = \"identity\"\ndevice = 2\nrevision = 7\nat = \"{}us\"\n",
        at / 1000
    );
    let error = scan(&bench, &machine(), faults(&fault)).error;
    let parts = [
        "`y` (position 2, station 0x1002)",
        "its EEPROM changed during the scan",
    ];
    assert_contains(&error.unwrap_or_default(), &parts);
}

/// ETG.1000.4, 0x0500: other MainDevices leave the EEPROM to the PDI. In Init the device does not need
/// it.
#[test]
fn eeprom_that_belongs_to_the_pdi_is_taken() {
    let lend = |mut bus| {
        let stop = CancelToken::default();
        let lent = run_on_link(&mut bus, virtual_time().clock, &stop, async |wire| {
            wire.write_at(1, EEPROM_CONFIGURATION, &[1]).await
        });
        assert_eq!(lent.expect("carried"), Ok(1));
        Box::new(bus) as Box<dyn Link>
    };
    assert_eq!(run_on_link_of(lend), Ok(()));
}

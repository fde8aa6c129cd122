//! Ethernet over EtherCAT (ETG.1000.6 clause 5.7) on the simulated bus: IP parameters, the virtual
//! switch, and what EoE must not disturb.

use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::Machine;
use ecaxis_master::eoe::{EthernetInterface, FrameDelay};
use ecaxis_master::mailbox::{MailboxError, Mailboxes};
use ecaxis_master::session::{
    Attachments, AxisSummary, Observer, Options, Outcome, Progress, Summary, run_attached,
};
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::{Heard, faults, virtual_time};

mod client;

use client::{Client, Seen};

/// Drives that move there and back, the first ones with EoE.
fn text(count: usize, with_eoe: usize, steps: &str) -> String {
    let mut text = String::from("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n");
    for n in 0..count {
        let eoe = match n < with_eoe {
            true => format!("eoe = {{ ip = \"192.168.7.{}\" }}\n", 11 + n),
            false => String::new(),
        };
        text += &format!(
            "\n[[device]]\nname = \"a{n}\"\nesi = \"esi/SV1.xml\"\nposition = {n}\nmode = \"csp\"\n{eoe}\
             [device.axis]\nunit = \"turn\"\nper_turn = 1.0\nencoder = 131072\n\
             limits = {{ position = [-100.0, 100.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }}\n\
             \n[[stop.group]]\nname = \"g{n}\"\naxes = [\"a{n}\"]\noutside = \"continue\"\n",
        );
    }
    text + steps
}

const MOVES: &str =
    "\n[[step]]\nmove = { a0 = 80.0, a1 = 40.0 }\n\n[[step]]\nmove = { a0 = 0.0, a1 = 0.0 }\n";

fn machine(count: usize, with_eoe: usize, steps: &str) -> Machine {
    Bench::new().machine(&text(count, with_eoe, steps))
}

/// Runs a machine with a client that asks a host.
fn run(machine: Machine, options: Options, host: [u8; 4]) -> (Outcome, Heard, Seen) {
    let (client, seen) = Client::new(host);
    let mut heard = Heard::default();
    let attachments = Attachments {
        ethernet: Some(Box::new(client)),
        ..Attachments::default()
    };
    let outcome = run_attached(machine, options, Arc::default(), &mut heard, attachments);
    let seen = seen.lock().unwrap().clone();
    (outcome, heard, seen)
}

fn well(outcome: Outcome, heard: &Heard) -> Summary {
    let warnings = heard.warnings();
    let result = outcome.result;
    result.unwrap_or_else(|error| panic!("{error}; {warnings:?}"));
    outcome.summary.expect("a summary")
}

/// Bring-up takes another time, so the motion begins at another phase of the drive's own cycle.
fn same_motion(a: &AxisSummary, b: &AxisSummary) {
    assert!(
        (a.final_position - b.final_position).abs() < 1e-4,
        "{a:?} {b:?}"
    );
    let (a, b) = (a.largest_following_error, b.largest_following_error);
    assert!((a - b).abs() <= 0.05 * a.abs(), "{a} {b}");
}

/// Ping and page of a drive pass the switch while the axes move as without EoE.
#[test]
fn page_of_a_drive_is_open_while_the_axes_move() {
    let (outcome, heard, seen) = run(machine(2, 2, MOVES), virtual_time(), [192, 168, 7, 11]);
    let with = well(outcome, &heard);
    let (outcome, heard) = ecaxis_test_support::run(machine(2, 0, MOVES), virtual_time());
    let without = well(outcome, &heard);
    assert!(
        seen.echoes.len() > 50,
        "{} of {}",
        seen.echoes.len(),
        seen.pings
    );
    assert!(seen.pages.len() > 10, "{} pages", seen.pages.len());
    let positions: Vec<_> = seen
        .pages
        .iter()
        .map(|(_, page)| {
            assert!(page.starts_with("HTTP/1.1 200 OK\r\n"), "{page}");
            assert!(page.contains("<h1>SV1</h1>"), "{page}");
            let (_, value) = page.split_once("position</td><td>").expect("a row");
            value.split('<').next().unwrap().parse::<i64>().unwrap()
        })
        .collect();
    let largest = positions.iter().max().unwrap();
    assert!(*largest > 40 * 131_072, "{positions:?}");
    assert!(
        seen.pages
            .iter()
            .any(|(_, page)| page.contains("OperationEnabled"))
    );
    // The cycle is the same, and so is the motion.
    assert_eq!(with.counters.wkc_errors, 0);
    assert_eq!(with.counters.wkc_errors, without.counters.wkc_errors);
    for (with, without) in with.axes.iter().zip(&without.axes) {
        assert_eq!(with.final_position, without.final_position);
        assert_eq!(
            with.largest_following_error,
            without.largest_following_error
        );
    }
    let [a0, a1, host] = &with.ethernet[..] else {
        panic!("{:?}", with.ethernet);
    };
    let names = [&a0.name, &a1.name, &host.name];
    assert_eq!(names, ["a0", "a1", "interface"]);
    assert!(a0.from_port > 100 && host.from_port > 100);
    assert_eq!(
        (a0.incomplete, a0.invalid, a0.not_taken),
        (0, 0, 0),
        "{a0:?}"
    );
    // Only broadcasts reach the other drive once the switch knows the addresses.
    assert!(a1.to_port < 20, "{a1:?}");
    assert!(without.ethernet.is_empty());
}

#[test]
fn ip_parameters_are_refused_with_device_step_and_result() {
    // The mailbox of the device knows no EoE, whatever the ESI says.
    let bench = Bench::new();
    let machine = bench.machine(&text(2, 1, MOVES));
    let plain = Bench::new();
    plain.change("esi/SV1.xml", |esi| {
        esi.replace("<EoE IP=\"1\" MAC=\"1\" TimeStamp=\"0\"/>", "")
    });
    let other = plain.machine(&text(2, 0, MOVES));
    let bus = ecaxis_master::session::simulated_bus(&other, 1, None, None).unwrap();
    let link = Box::new(ecaxis_master::link::sim::SimLink::new(bus));
    let mut heard = Heard::default();
    let outcome = ecaxis_master::session::run_on(
        link,
        machine,
        virtual_time(),
        Arc::<CancelToken>::default(),
        &mut heard,
    );
    let error = outcome.result.expect_err("refused").to_string();
    for part in [
        "`a0`",
        "IP parameters by EoE (192.168.7.11/24, MAC 02:45:43:",
        "the mailbox refused the request with 0x0002",
    ] {
        assert!(error.contains(part), "{error}");
    }
}

/// A bus whose two devices have longer mailboxes and time stamps.
fn stamped(keys: &str) -> Machine {
    let bench = Bench::new();
    bench.change("esi/SV1.xml", |esi| {
        esi.replace("DefaultSize=\"128\"", "DefaultSize=\"160\"")
            .replace("TimeStamp=\"0\"", "TimeStamp=\"1\"")
    });
    let good = text(2, 2, MOVES);
    bench.machine(&good.replace(".11\" }", &format!(".11\", {keys} }}")))
}

/// The host of a device hears what its filter passes. Its own address passes always, but ARP asks for
/// it with a broadcast.
#[test]
fn mac_filter_decides_what_a_device_hears() {
    let own = [192, 168, 7, 11];
    for (keys, hears) in [
        (
            "filters = [\"01:80:c2:00:00:0e\"], broadcasts = false",
            false,
        ),
        ("filters = [\"01:80:c2:00:00:0e\"]", true),
        (
            "filters = [\"ff:ff:ff:00:00:00\"], broadcasts = false",
            false,
        ),
    ] {
        let (outcome, heard, seen) = run(stamped(keys), virtual_time(), own);
        well(outcome, &heard);
        assert_eq!(
            seen.echoes.len() > 50,
            hears,
            "{keys}: {}",
            seen.echoes.len()
        );
        assert_eq!(seen.echoes.is_empty(), !hears, "{keys}");
    }
}

/// The delays by time stamps are shorter than the round trips that a program sees, and both
/// directions together are the larger part of them.
#[test]
fn time_stamps_give_the_delay_in_both_directions() {
    let own = [192, 168, 7, 11];
    let (outcome, heard, seen) = run(stamped("time_stamps = true"), virtual_time(), own);
    let summary = well(outcome, &heard);
    let [a0, a1, _] = &summary.ethernet[..] else {
        panic!("{:?}", summary.ethernet);
    };
    let (from, to) = (a0.from_delay, a0.to_delay);
    assert!(from.frames > 100 && to.frames > 100, "{a0:?}");
    // Without times: the frames before the time of the bus was known.
    assert!(
        2 * from.frames > a0.from_port && 2 * to.frames > a0.to_port,
        "{a0:?}"
    );
    let mean = |delay: FrameDelay| delay.mean_ns().expect("frames");
    let round_trips = seen.round_trips.iter().sum::<u64>() / seen.round_trips.len() as u64;
    let both = mean(from) + mean(to);
    println!("{both} of {round_trips} ns");
    assert!(
        both < round_trips * 5 / 4 && both > round_trips / 2,
        "{both} {round_trips}"
    );
    let longest = *seen.round_trips.iter().max().expect("echoes");
    assert!(
        from.max_ns >= mean(from) && from.max_ns <= longest,
        "{a0:?} {longest}"
    );
    assert!(
        to.max_ns >= mean(to) && to.max_ns <= longest,
        "{a0:?} {longest}"
    );
    assert!(seen.echoes.len() > 50);
    assert_eq!((a1.from_delay.frames, a1.to_delay.frames), (0, 0), "{a1:?}");
}

/// A device that is lost and returns gets its parameters again, and its page is back.
#[test]
fn lost_device_returns_with_its_page() {
    let steps = "\n[[step]]\nmove = { a0 = 90.0 }\n\n[[step]]\nmove = { a0 = 0.0 }\n\n[[step]]\ndwell = \"3s\"\n";
    let off = "[[fault]]\nkind = \"power-off\"\ndevice = 1\nat = \"2s\"\nfor = \"1s\"\n";
    let (outcome, heard, seen) = run(machine(2, 2, steps), faults(off), [192, 168, 7, 12]);
    let returns = heard.0.iter().filter_map(|progress| match progress {
        Progress::DeviceReturned { device, .. } => Some(device.name.as_str()),
        _ => None,
    });
    let returned: Vec<_> = returns.collect();
    assert_eq!(returned, ["a1"], "{:?}", heard.warnings());
    let summary = outcome.summary.expect("a summary");
    let times: Vec<_> = seen.pages.iter().map(|page| page.0).collect();
    let gap = times
        .windows(2)
        .position(|pair| pair[1] - pair[0] > 900_000_000);
    let gap = gap.unwrap_or_else(|| panic!("no pause: {times:?}"));
    assert!(gap > 3 && times.len() - gap > 5, "{gap}: {times:?}");
    let port = &summary.ethernet[1];
    assert!(port.not_taken + port.overflows > 0, "{port:?}");
}

/// Passes the mailboxes of the run on.
struct Passes {
    heard: Heard,
    mailboxes: Arc<Mutex<Option<Mailboxes>>>,
}

impl Observer for Passes {
    fn progress(&mut self, progress: &Progress) {
        if let Progress::Mailboxes(mailboxes) = progress {
            *self.mailboxes.lock().unwrap() = Some(mailboxes.clone());
        }
        self.heard.progress(progress);
    }
}

type Upload = Pin<Box<dyn Future<Output = Result<Vec<u8>, MailboxError>> + Send>>;

/// A client that also reads an object of a device again and again, in the time of the run.
struct WithReads {
    client: Client,
    device: &'static str,
    mailboxes: Arc<Mutex<Option<Mailboxes>>>,
    read: Option<(u64, Upload)>,
    next: u64,
    /// The duration of each transfer in ns.
    durations: Arc<Mutex<Vec<u64>>>,
}

impl std::fmt::Debug for WithReads {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("WithReads")
    }
}

impl WithReads {
    fn read(&mut self, now: u64) {
        if self.read.is_none() && now >= self.next {
            let Some(mailboxes) = self.mailboxes.lock().unwrap().clone() else {
                return;
            };
            self.next = now + 50_000_000;
            let device = self.device;
            let upload = async move { mailboxes.upload(device, 0x1018, 1).await };
            self.read = Some((now, Box::pin(upload)));
        }
        if let Some((since, upload)) = &mut self.read
            && let Poll::Ready(done) = upload
                .as_mut()
                .poll(&mut Context::from_waker(Waker::noop()))
        {
            assert_eq!(done, Ok(0x0e0b_u32.to_le_bytes().to_vec()));
            self.durations.lock().unwrap().push(now - *since);
            self.read = None;
        }
    }
}

impl EthernetInterface for WithReads {
    fn receive(&mut self, now: u64, buffer: &mut [u8]) -> Option<usize> {
        self.read(now);
        self.client.receive(now, buffer)
    }

    fn send(&mut self, now: u64, frame: &[u8]) -> bool {
        self.client.send(now, frame)
    }
}

/// A device that sends broadcasts without end takes its own share only: SDOs of other devices and its
/// own are served, the cycle and the motion are the same, and the switch keeps bounded queues.
#[test]
fn flooding_device_disturbs_neither_cycle_nor_other_mailboxes() {
    let flood = "[[fault]]\nkind = \"eoe-flood\"\ndevice = 0\n";
    let run = |script: &str, device| {
        let (client, seen) = Client::new([192, 168, 7, 12]);
        let durations = Arc::<Mutex<Vec<u64>>>::default();
        let mailboxes = Arc::<Mutex<Option<Mailboxes>>>::default();
        let with_reads = WithReads {
            client,
            device,
            mailboxes: Arc::clone(&mailboxes),
            read: None,
            next: 0,
            durations: Arc::clone(&durations),
        };
        let attachments = Attachments {
            ethernet: Some(Box::new(with_reads)),
            ..Attachments::default()
        };
        let mut observer = Passes {
            heard: Heard::default(),
            mailboxes,
        };
        let machine = machine(3, 2, MOVES);
        let options = faults(script);
        let outcome = run_attached(machine, options, Arc::default(), &mut observer, attachments);
        let summary = well(outcome, &observer.heard);
        let mut durations = durations.lock().unwrap().clone();
        durations.sort_unstable();
        assert!(durations.len() > 20, "{device}: {durations:?}");
        let median = durations[durations.len() / 2];
        (summary, seen.lock().unwrap().clone(), median)
    };
    let (quiet, _, other_quiet) = run("", "a2");
    let (flooded, seen, other_flooded) = run(flood, "a2");
    let (_, _, own_flooded) = run(flood, "a0");
    println!(
        "SDO of another device: {} µs, {} µs next to a flooding one; of the flooding one {} µs",
        other_quiet / 1000,
        other_flooded / 1000,
        own_flooded / 1000
    );
    assert!(
        other_flooded <= 3 * other_quiet,
        "{other_flooded} {other_quiet}"
    );
    assert!(own_flooded <= 200_000_000);
    assert_eq!(flooded.counters.wkc_errors, 0);
    assert!(quiet.counters.cycles.abs_diff(flooded.counters.cycles) < 50);
    for (quiet, flooded) in quiet.axes.iter().zip(&flooded.axes) {
        same_motion(quiet, flooded);
    }
    let [port, other, _] = &flooded.ethernet[..] else {
        panic!("{:?}", flooded.ethernet);
    };
    assert!(port.from_port > 20, "{port:?}");
    // The broadcasts reach the other drive, as far as its mailbox has room.
    assert!(other.to_port + other.overflows > 20, "{other:?}");
    assert!(
        seen.pages.len() > 1,
        "{} pages of the other drive",
        seen.pages.len()
    );
}

/// Fragments that are lost, repeated, out of order or contradictory are counted; a page is slow, and
/// nothing else suffers.
#[test]
fn wrong_fragments_are_counted_and_dropped() {
    let script = "[[fault]]\nkind = \"eoe-fragments\"\ndevice = 0\nat = \"1.5s\"\n";
    let (outcome, heard, seen) = run(machine(2, 1, MOVES), faults(script), [192, 168, 7, 11]);
    let summary = well(outcome, &heard);
    assert_eq!(summary.counters.wkc_errors, 0);
    let port = &summary.ethernet[0];
    assert!(port.incomplete > 10, "{port:?}");
    assert!(!seen.pages.is_empty());
}

/// Mistakes in the keys of EoE, each with its message and remedy.
#[test]
#[rustfmt::skip] // one row per mistake
fn wrong_keys_have_a_message_and_a_remedy() {
    let bench = Bench::new();
    let good = text(2, 2, MOVES);
    let check = |keys: &str, tap: &str| {
        let text = good.replace("eoe = { ip = \"192.168.7.11\" }", keys);
        bench.parse(&format!("{text}\n{tap}"))
    };
    for (keys, tap, message, hint) in [
        ("eoe = { ip = \"192.168.7\" }", "", "\"192.168.7\" is not an IPv4 address", "192.168.7.11"),
        ("eoe = { ip = \"192.168.7.255\" }", "", "may have the address 192.168.7.255", "neither the first nor the last"),
        ("eoe = { ip = \"224.0.0.1\" }", "", "may have the address 224.0.0.1", ""),
        ("eoe = { ip = \"192.168.7.12\" }", "", "two devices have the address 192.168.7.12", "address of its own"),
        ("eoe = { ip = \"192.168.7.11\", netmask = \"255.0.255.0\" }", "", "255.0.255.0 is not a subnet mask", "255.255.255.0"),
        ("eoe = { ip = \"192.168.7.11\", gateway = \"10.0.0.1\" }", "", "gateway 10.0.0.1 is not in the subnet", ""),
        ("eoe = { gateway = \"192.168.7.1\" }", "", "keeps its own IP parameters", "add `ip"),
        ("eoe = { ip = \"192.168.7.11\", mac = \"01:00:5e:00:00:01\" }", "", "is not the MAC address of a device", "even first one"),
        ("eoe = { ip = \"192.168.7.11\", mac = \"02:00:00:00:00\" }", "", "is not the MAC address of a device", ""),
        ("eoe = { ip = \"192.168.7.11\", name = \"a b\" }", "", "\"a b\" is not a DNS name", "32 letters"),
        ("eoe = { ip = \"192.168.7.11\", filters = [\"01\"] }", "", "`filters` takes up to 15 addresses of six bytes", "01:80:c2:00:00:0e"),
        ("eoe = { ip = \"192.168.7.11\", filters = [], filter_masks = [\"00:00:00:00:00:00\", \"00:00:00:00:00:00\", \"00:00:00:00:00:00\", \"00:00:00:00:00:00\"] }", "", "`filter_masks` takes up to 3", ""),
        ("eoe = { ip = \"192.168.7.11\", filters = [] }", "", "needs a mailbox of 132 bytes, the device has 128 (ESI)", "omit `filters`"),
        ("eoe = { ip = \"192.168.7.11\", broadcasts = false }", "", "the device keeps its own filter", "add `filters"),
        ("eoe = { ip = \"192.168.7.11\", time_stamps = true }", "", "no time stamps (`TimeStamp` of `EoE`)", "omit `time_stamps`"),
        ("eoe = { ipp = \"192.168.7.11\" }", "", "unknown key `ipp`", "did you mean `ip`?"),
        ("eoe = {}", "[eoe]\naddress = \"192.168.7.1/24\"", "`tap` is missing", "ecat0"),
        ("eoe = {}", "[eoe]\ntap = \"sixteen-letters1\"", "is not the name of an interface", ""),
        ("eoe = {}", "[eoe]\ntap = \"ecat0\"\naddress = \"192.168.7.0/24\"", "is not an IPv4 address with its prefix", ""),
        ("eoe = {}", "[eoe]\ntap = \"ecat0\"\naddress = \"192.168.7.12/24\"", "is the address of `a1` as well", "different addresses"),
        ("eoe = {}", "[eoe]\ntap = \"ecat0\"\naddress = \"10.0.0.1/8\"", "`a1` (192.168.7.12) is not in the subnet", ""),
    ] {
        let problem = check(keys, tap).expect_err(keys);
        assert!(problem.contains(message), "{keys} {tap}: {problem}");
        assert!(problem.contains(hint), "{keys} {tap}: {problem}");
        assert!(problem.contains("machine.toml:"), "{problem}");
    }
    let twice = good.replace(".11\" }", ".11\", mac = \"02-00-00-00-00-0A\" }").replace(".12\" }", ".12\", mac = \"02:00:00:00:00:0a\" }");
    let problem = bench.parse(&twice).expect_err("one MAC address for two");
    assert!(problem.contains("two devices have the address 02:00:00:00:00:0a"), "{problem}");
    let other = good.replace("esi/SV1.xml", "esi/IDX.xml");
    let problem = bench.parse(&other).expect_err("no EoE");
    assert!(problem.contains("has no EoE") && problem.contains("omit `eoe`"), "{problem}");
    let tap = "[eoe]\ntap = \"ecat0\"\naddress = \"192.168.7.1/24\"\n";
    let keys = "eoe = { ip = \"192.168.7.11\", mac = \"02-00-00-00-00-0A\", name = \"drive\", dns = \"192.168.7.1\" }";
    let machine = check(keys, tap).expect("no mistake");
    assert_eq!(machine.tap.expect("a TAP interface").to_string(), "interface ecat0, 192.168.7.1/24");
    let shown: Vec<_> = machine.devices.iter().map(|d| d.eoe.as_ref().expect("EoE").to_string()).collect();
    assert_eq!(shown[0], "192.168.7.11/24, MAC 02:00:00:00:00:0a, DNS server 192.168.7.1, name drive");
    assert!(shown[1].starts_with("192.168.7.12/24, MAC 02:45:43:"), "{shown:?}");
}

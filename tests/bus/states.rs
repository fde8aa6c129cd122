//! State changes as ETG.1000.6, ETG.1020 and ETG.2000 define them, on the whole bus.

use std::fmt;
use std::sync::{Arc, Mutex};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::{self, Nanos};
use ecaxis_master::config::Machine;
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::link::{Link, LinkError, MAX_FRAME};
use ecaxis_master::session::{self, Options, Outcome, simulated_bus};
use ecaxis_sim::Segment;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::recordings::{APWR, BWR, Datagram, FPWR, Frame, LRW, datagrams};
use ecaxis_test_support::{Heard, faults, load, machine, recorded, run, run_well, virtual_time};

const MS: u64 = 1_000_000;

/// Runs a machine on its simulated bus, which `change` changes first.
pub fn run_changed(machine: Machine, change: impl FnOnce(&mut Segment)) -> (Outcome, Heard) {
    let options = virtual_time();
    options.clock.enter();
    let mut bus = simulated_bus(&machine, 1, None, None).expect("a bus");
    change(&mut bus);
    let mut heard = Heard::default();
    let link = Box::new(SimLink::new(bus));
    let stop = Arc::<CancelToken>::default();
    let outcome = session::run_on(link, machine, options, stop, &mut heard);
    (outcome, heard)
}

/// Returns a drive of `configs/esi` and a drive whose ESI has these time-outs; it needs `ms` for each
/// state change.
fn drives(bus: &str, timeouts: &str, ms: u64) -> Machine {
    let bench = Bench::new();
    bench.write("own.xml", &bench.read("esi/EPOS4.xml"));
    bench.change("own.xml", |esi| {
        let info = format!(
            "<Info><StateMachine><Timeout>{timeouts}</Timeout></StateMachine></Info><GroupType>"
        );
        esi.replacen("<GroupType>", &info, 1)
    });
    let mut text = format!("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n{bus}");
    let slow = format!("[device.sim]\nstate_change = \"{ms}ms\"\n");
    let both = [("x", "esi/EPOS4.xml", ""), ("y", "own.xml", &*slow)];
    for (position, (name, file, sim)) in both.into_iter().enumerate() {
        text += &format!(
            "[[device]]\nname = \"{name}\"\nesi = \"{file}\"\nposition = {position}\nmode = \"csp\"\n\
             [device.axis]\nunit = \"turn\"\nper_turn = 1.0\nencoder = 2000\n\
             limits = {{ position = [-100.0, 100.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }}\n{sim}"
        );
    }
    bench.machine(&(text + "[[step]]\nmove = { x = 1.0, y = 1.0 }\n"))
}

/// ETG.1000.6, 6.4: a broadcast requests a state from all devices. A controller takes no other request
/// until its processor has read it, so slow devices are not asked again.
#[test]
fn way_back_requests_each_state_once_from_all_devices() {
    for ms in [1, 150, 500] {
        let folder = tempfile::tempdir().expect("a folder");
        let (options, recording) = recorded(virtual_time(), folder.path());
        let timeouts = "<PreopTimeout>900</PreopTimeout><SafeopOpTimeout>900</SafeopOpTimeout>\
             <BackToInitTimeout>900</BackToInitTimeout><BackToSafeopTimeout>900</BackToSafeopTimeout>";
        run_well(drives("", timeouts, ms), options);
        let requests = datagrams(&recording).into_iter();
        let is_request = |d: &Datagram| matches!(d.command, BWR | FPWR) && d.register() == 0x0120;
        let requests = requests.filter(|d| d.sent && is_request(d));
        let requests: Vec<_> = requests.map(|d| (d.command, d.data[0])).collect();
        let op = requests.iter().rposition(|(_, state)| *state == 8);
        let back = requests.get(op.expect("Op") + 1..);
        assert_eq!(back, Some(&[(BWR, 4), (BWR, 2), (BWR, 1)][..]), "{ms} ms");
    }
}

/// ETG.1000.6, 6.4: a device that refuses a state is asked alone, with the acknowledgement of its error.
#[test]
fn way_back_asks_only_the_device_alone_that_refuses() {
    let script = "[[fault]]\nkind = \"refuse-state\"\ndevice = 1\nstate = \"preop\"\ncode = 0x0011\nat = \"120ms\"\n";
    let folder = tempfile::tempdir().expect("a folder");
    let (options, recording) = recorded(faults(script), folder.path());
    let (outcome, _) = run(drives("", "", 1), options);
    let error = outcome.result.expect_err("it refuses").to_string();
    assert!(
        error.contains("`y`") && error.contains("refused PreOp"),
        "{error}"
    );
    let requests = datagrams(&recording).into_iter();
    let alone = requests.filter(|d| d.sent && d.command == FPWR && d.register() == 0x0120);
    let alone: Vec<_> = alone.map(|d| (d.station(), d.data[0])).collect();
    // On the way up ethercrab requests PreOp, then we request SafeOp, from each device.
    let back = alone.get(4..).unwrap_or_default();
    assert_eq!(back.first(), Some(&(0x1001, 0x14)), "{alone:x?}");
    assert!(
        back.iter().all(|(station, _)| *station == 0x1001),
        "{alone:x?}"
    );
}

/// Runs [`drives`].
fn run_slow(bus: &str, timeouts: &str, ms: u64) -> Result<(), String> {
    let (outcome, _) = run(drives(bus, timeouts, ms), virtual_time());
    outcome.result.map_err(|error| error.to_string())
}

/// ETG.2000, `Info/StateMachine/Timeout`: the time-outs of a device are those of its ESI. ETG.1020:
/// otherwise 10 s to SafeOp, which is enough for this device.
#[test]
fn state_change_times_out_after_the_time_of_the_esi() {
    let short = "<SafeopOpTimeout>200</SafeopOpTimeout>";
    let error = run_slow("", short, 300).expect_err("too slow");
    assert!(
        error.contains("`y`") && error.contains("did not reach SafeOp within 200 ms, is in PreOp"),
        "{error}"
    );
    let back = "<BackToSafeopTimeout>400</BackToSafeopTimeout>";
    assert_eq!(run_slow("", back, 300), Ok(()));
}

/// ETG.2000, `Info/StateMachine/Timeout`: longer times than the defaults of ETG.1020 (3 s to PreOp,
/// 10 s to SafeOp and Op, 5 s back to Init, 200 ms back to SafeOp).
#[test]
fn state_change_may_take_as_long_as_the_esi_says() {
    let long = "<PreopTimeout>30000</PreopTimeout><SafeopOpTimeout>30000</SafeopOpTimeout>\
                <BackToInitTimeout>20000</BackToInitTimeout>\
                <BackToSafeopTimeout>20000</BackToSafeopTimeout>";
    assert_eq!(run_slow("", long, 12_000), Ok(()));
    // The machine file's time-out replaces that of the ESI.
    let error = run_slow("op_timeout = \"2s\"\n", long, 12_000).expect_err("too slow");
    assert!(
        error.contains("`y`") && error.contains("did not reach Op within 2000 ms, is in SafeOp"),
        "{error}"
    );
}

/// ETG.1020: the default of 200 ms back to SafeOp.
#[test]
fn way_back_to_safe_op_has_its_own_time_out() {
    let error = run_slow("", "<PreopTimeout>4000</PreopTimeout>", 300).expect_err("too slow");
    assert!(
        error.contains("`y`") && error.contains("did not reach SafeOp within 200 ms, is in Op"),
        "{error}"
    );
}

/// Returns what was written to a station, and the states that were requested from all: the register,
/// and the byte at `byte` of its data.
fn written(datagrams: &[Datagram], station: u16, registers: &[(u16, usize)]) -> Vec<(u16, u8)> {
    let state_of_all = |d: &Datagram| d.command == BWR && d.register() == 0x0120;
    let sent = datagrams
        .iter()
        .filter(|d| d.sent && (d.command == FPWR && d.station() == station || state_of_all(d)));
    let found = sent.filter_map(|datagram| {
        let (register, byte) = registers.iter().find(|(r, _)| *r == datagram.register())?;
        Some((*register, *datagram.data.get(*byte)?))
    });
    found.collect()
}

/// ETG.2000, `Sm` attribute `OpOnly` (ETG.1500, feature 104): the SyncManager is disabled outside Op.
/// ETG.1000.4: without its FMMU, a device adds nothing for outputs to the working counter of LRW.
#[test]
fn op_only_sync_manager_is_enabled_in_op_only() {
    let bench = Bench::new();
    bench.write("own.xml", &bench.read("esi/IO8.xml"));
    bench.change("own.xml", |esi| {
        let own = esi.replace("Enable=\"1\">Outputs", "Enable=\"1\" OpOnly=\"1\">Outputs");
        // Without device emulation, the device refuses Op while the SyncManager is disabled.
        own.replace("<ConfigData>0401", "<ConfigData>0400")
    });
    let machine = bench.machine(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n\
         [[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\nmode = \"csp\"\n\
         [device.axis]\nunit = \"turn\"\nper_turn = 1.0\nencoder = 2000\n\
         limits = { position = [-100.0, 100.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }\n\
         [[device]]\nname = \"io\"\nesi = \"own.xml\"\nposition = 1\n\
         [[step]]\nset = { io.\"Output 3\" = true }\n[[step]]\nmove = { x = 1.0 }\n",
    );
    let folder = tempfile::tempdir().expect("a folder");
    let (options, recording) = recorded(virtual_time(), folder.path());
    let summary = run_well(machine, options);
    assert_eq!(summary.counters.wkc_errors, 0);
    let datagrams = datagrams(&recording);

    // The activation of SyncManager 0 (0x0806) and of FMMU 0 (0x060C), and AL control.
    let registers = [
        (0x0800, 6),
        (0x0600, 12),
        (0x0806, 0),
        (0x060c, 0),
        (0x0120, 0),
    ];
    assert_eq!(
        written(&datagrams, 0x1001, &registers),
        [
            (0x0120, 2),
            (0x0800, 0),
            (0x0600, 0),
            (0x0120, 4),
            (0x0806, 1),
            (0x060c, 1),
            (0x0120, 8),
            (0x0120, 4),
            (0x060c, 0),
            (0x0806, 0),
            (0x0120, 2),
            (0x0120, 1),
        ]
    );
    let logical = datagrams.iter().filter(|d| !d.sent && d.command == LRW);
    let mut counters: Vec<u16> = logical.map(|d| d.working_counter).collect();
    counters.dedup();
    // SafeOp: 3 of the drive and 1 of the inputs; Op: and 2 of the outputs.
    assert_eq!(counters.get(..3), Some(&[4, 6, 4][..]), "{counters:?}");
}

/// A simulated bus that keeps every write to AL control.
struct AlControls {
    bus: SimLink,
    written: Arc<Mutex<Vec<Datagram>>>,
}

impl fmt::Debug for AlControls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("AlControls")
    }
}

impl Link for AlControls {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        let datagrams = Frame::parse(frame).datagrams.into_iter();
        let writes =
            datagrams.filter(|d| [APWR, FPWR, BWR].contains(&d.command) && d.register() == 0x0120);
        self.written.lock().expect("kept").extend(writes);
        self.bus.send(frame)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        self.bus.recv(buf)
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.bus.next_arrival()
    }
}

/// Returns an APWR of AL control.
fn write_al_control(position: u16, value: u8) -> [u8; 30] {
    let mut frame = [0; 30];
    frame[..18].copy_from_slice(&[
        0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x10, 0x10, 0x10, 0x10, 0x10, 0x30, 0x88, 0xa4, 14,
        0x10, APWR, 0,
    ]);
    frame[18..20].copy_from_slice(&position.wrapping_neg().to_le_bytes());
    frame[20..24].copy_from_slice(&[0x20, 0x01, 2, 0]);
    frame[26] = value;
    frame
}

/// ETG.1500, feature 103: a device with device emulation (0x0140 bit 8) never receives the
/// acknowledge bit, not even as a broadcast. ETG.1000.6, 6.4: every other device leaves an error after
/// the acknowledgement only; here another MainDevice has left both in one.
#[test]
fn bring_up_acknowledges_errors_of_devices_without_device_emulation_only() {
    const COUPLER: u16 = 0;
    const DRIVE: u16 = 5;
    let machine = load("terminals.toml");
    let options = virtual_time();
    options.clock.enter();
    let mut bus = simulated_bus(&machine, 1, None, None).expect("a bus");
    // The coupler copies the error bit; the drive refuses Op in Init.
    for (position, value) in [(COUPLER, 0x12), (DRIVE, 0x08)] {
        bus.transit(&mut write_al_control(position, value), clock::now());
        options.clock.relax(clock::now() + 10 * MS);
        bus.advance(clock::now());
    }
    let states = [COUPLER, DRIVE].map(|position| {
        let device = bus.device(position.into()).expect("a device");
        device.registers(0x0130, 1)[0]
    });
    assert_eq!(states, [0x12, 0x11]);

    let written = Arc::default();
    let link = Box::new(AlControls {
        bus: SimLink::new(bus),
        written: Arc::clone(&written),
    });
    let stop = Arc::<CancelToken>::default();
    let outcome = session::run_on(link, machine, options, stop, &mut Heard::default());
    outcome.result.expect("comes up and moves");
    let written = written.lock().expect("kept");
    let acknowledged: Vec<_> = written.iter().filter(|d| d.data[0] & 0x10 != 0).collect();
    let [one] = acknowledged[..] else {
        panic!("{acknowledged:?}")
    };
    let to = (one.command, one.station(), one.data[0]);
    assert_eq!(to, (APWR, DRIVE.wrapping_neg(), 0x11));
}

/// Runs one device whose ESI is a changed one of `configs/esi`, next to nothing else. Returns the
/// datagrams, or the error.
fn run_alone(
    file: &str,
    rest: &str,
    change: impl FnOnce(&str) -> String,
) -> Result<Vec<Datagram>, String> {
    let bench = Bench::new();
    bench.write("own.xml", &bench.read(&format!("esi/{file}")));
    bench.change("own.xml", change);
    let machine = bench.machine(&format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n\
         [[device]]\nname = \"x\"\nesi = \"own.xml\"\nposition = 0\n{rest}"
    ));
    let folder = tempfile::tempdir().expect("a folder");
    let (options, recording) = recorded(virtual_time(), folder.path());
    let (outcome, _) = run(machine, options);
    outcome.result.map_err(|error| error.to_string())?;
    let summary = outcome.summary.expect("a summary");
    assert_eq!(summary.counters.wkc_errors, 0);
    Ok(datagrams(&recording))
}

const DRIVE: &str = "mode = \"csp\"\n[device.axis]\nunit = \"turn\"\nper_turn = 1.0\nencoder = 2000\n\
    limits = { position = [-100.0, 100.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }\n\
    [[step]]\nmove = { x = 1.0 }\n";
const TERMINAL: &str = "[[step]]\nset = { x.\"Output 3\" = true }\n[[step]]\ndwell = \"20ms\"\n";

/// ETG.1000.6, 6.4: the mailbox SyncManagers are enabled before PreOp is requested, whatever the
/// ESI's `Enable` says. A device whose mailbox is disabled refuses PreOp (0x0016).
#[test]
fn mailbox_sync_managers_are_enabled_whatever_the_esi_says() {
    let done = run_alone("EPOS4.xml", DRIVE, |esi| {
        let own = esi.replace("Enable=\"1\">MBoxOut", "Enable=\"0\">MBoxOut");
        own.replace("Enable=\"1\">MBoxIn", "Enable=\"0\">MBoxIn")
    });
    let datagrams = done.expect("comes up");
    // From the EEPROM, then as the device needs them.
    let enabled = written(&datagrams, 0x1000, &[(0x0800, 6), (0x0808, 6)]);
    assert_eq!(
        enabled,
        [(0x0800, 0), (0x0808, 0), (0x0800, 1), (0x0808, 1)]
    );
}

/// ETG.2000: `Fmmu` elements are optional; the SyncManagers' texts say what they carry.
#[test]
fn device_without_fmmu_elements_is_mapped_by_its_sync_managers() {
    for (file, rest) in [("IO8.xml", TERMINAL), ("EPOS4.xml", DRIVE)] {
        let done = run_alone(file, rest, |esi| {
            let lines = esi.lines().filter(|line| !line.contains("<Fmmu>"));
            lines.collect::<Vec<_>>().join("\n")
        });
        let datagrams = done.unwrap_or_else(|error| panic!("{file}: {error}"));
        // Writing from FMMU 0, reading from FMMU 1.
        let kinds = written(&datagrams, 0x1000, &[(0x0600, 11), (0x0610, 11)]);
        assert_eq!(kinds, [(0x0600, 2), (0x0610, 1)], "{file}");
    }
}

/// Runs a terminal with two FMMUs (0x0004) and a second SyncManager of outputs at this address.
fn run_two_outputs(start: &str) -> Result<Vec<Datagram>, String> {
    run_alone("IO8.xml", TERMINAL, |esi| {
        let sm = format!(
            "<Sm DefaultSize=\"1\" StartAddress=\"{start}\" ControlByte=\"#x44\" Enable=\"1\">Outputs</Sm>\n\
             <RxPdo Fixed=\"1\" Mandatory=\"1\" Sm=\"2\"><Index>#x1601</Index><Name>Lamps</Name>\
             <Entry><Index>#x7010</Index><SubIndex>1</SubIndex><BitLen>8</BitLen><Name>Lamps</Name>\
             <DataType>USINT</DataType></Entry></RxPdo>\n<RxPdo "
        );
        esi.replacen("<RxPdo ", &sm, 1)
    })
}

/// ETG.1000.4, FMMU: one FMMU maps one contiguous area, whatever SyncManagers control it.
#[test]
fn adjoining_sync_managers_share_an_fmmu_if_there_are_too_few() {
    let datagrams = run_two_outputs("#x1001").expect("comes up");
    // Length, and the low byte of the physical address.
    let lengths = written(&datagrams, 0x1000, &[(0x0600, 4), (0x0610, 4)]);
    assert_eq!(lengths, [(0x0600, 2), (0x0610, 1)]);
    let kinds = written(&datagrams, 0x1000, &[(0x0600, 11), (0x0610, 11)]);
    assert_eq!(kinds, [(0x0600, 2), (0x0610, 1)]);

    let error = run_two_outputs("#x1010").expect_err("too few");
    assert!(
        error.contains("`x`")
            && error.contains("need 3 FMMUs, the controller has 2 (register 0x0004)"),
        "{error}"
    );
}

/// ETG.1020, explicit device identification: the device answers a request in AL control by bit 5 of
/// AL status. A device whose ESI has `IdentificationReg134` (ETG.2000) has a second for that.
#[test]
fn explicit_identification_waits_for_a_slow_device() {
    for (declared, comes_up) in [("1", true), ("0", false)] {
        let bench = Bench::new();
        bench.write("own.xml", &bench.read("esi/EPOS4.xml"));
        bench.change("own.xml", |esi| {
            let info = format!(
                "<Info><StateMachine><Timeout><BackToSafeopTimeout>1000</BackToSafeopTimeout></Timeout>\
                 </StateMachine><IdentificationReg134>{declared}</IdentificationReg134></Info><GroupType>"
            );
            esi.replacen("<GroupType>", &info, 1)
        });
        let machine = bench.machine(&format!(
            "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n\
             [[device]]\nname = \"x\"\nesi = \"own.xml\"\nid = 7\n{DRIVE}\
             [device.sim]\nstate_change = \"300ms\"\n"
        ));
        let (outcome, _) = run(machine, virtual_time());
        let result = outcome.result.map_err(|error| error.to_string());
        assert_eq!(result.is_ok(), comes_up, "{declared}: {result:?}");
        if let Err(error) = result {
            assert!(
                error.contains("no SubDevice has device identification 7"),
                "{error}"
            );
        }
    }
}

/// CiA 402-2, 0x60C2: interpolation time period, optional. A drive that refuses the cycle and keeps
/// another one comes up with a warning; a drive without the object (0x06020000) without one.
#[test]
fn refused_interpolation_time_is_a_warning() {
    for (code, warned) in [
        (0x0609_0030_u32, true),
        (0x0800_0022, true),
        (0x0602_0000, false),
    ] {
        let bench = Bench::new();
        let machine = bench.machine(&format!(
            "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n\
             [[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\n{DRIVE}"
        ));
        let script = format!(
            "[[fault]]\nkind = \"sdo-abort\"\nindex = 0x60c2\nsub = 1\ncode = 0x{code:08x}\n"
        );
        let (outcome, heard) = run(machine, faults(&script));
        let result = outcome.result.map_err(|error| error.to_string());
        assert_eq!(result, Ok(()), "0x{code:08x}");
        let warnings = heard.warnings();
        let about = |text: &&String| text.contains("refuses the interpolation time");
        assert_eq!(warnings.iter().any(|w| about(&w)), warned, "{warnings:?}");
    }
}

/// ETG.1000.6, PDO assignment: a device whose SyncManager carries no PDO may lack the object of its
/// assignment, or refuse to clear it. Neither prevents the run.
#[test]
fn an_assignment_that_cannot_be_cleared_is_no_error() {
    for (code, warned) in [(0x0602_0000_u32, false), (0x0601_0002, true)] {
        let bench = Bench::new();
        let machine = bench.machine(
            "enable = false\n[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n\
             [[device]]\nname = \"io\"\nesi = \"esi/MIO2.xml\"\nposition = 0\n\
             modules = [\"-\", \"OUT8\"]\n",
        );
        let script =
            format!("[[fault]]\nkind = \"sdo-abort\"\nindex = 0x1c13\ncode = 0x{code:08x}\n");
        let (outcome, heard) = run(machine, shortly(&script));
        let result = outcome.result.map_err(|error| error.to_string());
        assert_eq!(result, Ok(()), "0x{code:08x}");
        let warnings = heard.warnings();
        let about = |text: &&String| text.contains("refuses 0x1c13:00");
        assert_eq!(warnings.iter().any(|w| about(&w)), warned, "{warnings:?}");
    }
}

/// Devices without a program run until the end.
fn shortly(script: &str) -> Options {
    Options {
        limit: Some(20 * MS),
        ..faults(script)
    }
}

fn block(modules: &str) -> Machine {
    machine(&format!(
        "enable = false\n[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n\
         [[device]]\nname = \"io\"\nesi = \"esi/MIO2.xml\"\nposition = 0\nmodules = {modules}\n"
    ))
}

/// ETG.1020, AL status codes 0x0052 and 0x0070: a coupler that still looks for its terminals comes up
/// once it is ready, and one that does not become ready is named.
#[test]
fn coupler_that_is_not_ready_is_asked_again() {
    let abort = "kind = \"sdo-abort\"\nindex = 0xf030\ncode = 0x08000022";
    let refuse = "kind = \"refuse-state\"\nstate = \"safe-op\"\ncode";
    for fault in [
        format!("{refuse} = 0x52"),
        format!("{refuse} = 0x70"),
        abort.to_owned(),
    ] {
        let script = format!("[[fault]]\n{fault}\n");
        let soon = format!("{script}for = \"2s\"\n");
        let (outcome, heard) = run(block("[\"IN8\", \"OUT8\"]"), shortly(&soon));
        let result = outcome.result.map_err(|error| error.to_string());
        assert_eq!(result, Ok(()), "{fault}: {:?}", heard.warnings());
        let (outcome, _) = run(block("[\"IN8\", \"OUT8\"]"), shortly(&script));
        let error = outcome.result.expect_err("it is never ready").to_string();
        assert!(error.contains("`io` (position 0"), "{error}");
        assert!(error.contains("it was not ready within 10 s"), "{error}");
    }
    // Without the error bit, the first request lasts as long as the whole wait.
    let keys = "[\"IN8\", \"OUT8\"]\n[device.sim]\nquirks = { error_bit_missing = true }";
    let soon = format!("[[fault]]\n{refuse} = 0x52\nfor = \"2s\"\n");
    let (outcome, _) = run(block(keys), shortly(&soon));
    outcome.result.expect("it is asked again");
}

/// Lists of an earlier configuration are cleared, once a coupler is ready, and as far as the device
/// lets it: a check of the user's own start-up SDOs does not concern them.
#[test]
fn a_list_that_is_not_cleared_is_a_warning() {
    let ignored = "[[fault]]\nkind = \"sdo-ignored\"\nindex = 0xf030\n";
    let (outcome, heard) = run(block("[]\nstartup = { verify = true }"), shortly(ignored));
    outcome.result.expect("the device runs");
    let warnings = heard.warnings();
    let named = |w: &&String| w.contains("0xf030:00") && w.contains("holds 0x02");
    assert_eq!(warnings.iter().filter(named).count(), 1, "{warnings:?}");

    let busy = "[[fault]]\nkind = \"sdo-abort\"\nindex = 0xf030\ncode = 0x08000022\nfor = \"2s\"\n";
    let (outcome, heard) = run(block("[]"), shortly(busy));
    outcome.result.expect("the device runs");
    assert!(!heard.warnings().iter().any(|w| w.contains("0xf030")));
}

/// The modules in the slots are others than those of the file. The device refuses them, or takes them.
#[test]
fn modules_that_differ_are_named() {
    let (plugged, file) = (block("[\"OUT8\", \"IN8\"]"), block("[\"IN8\", \"OUT8\"]"));
    // The device detects its modules by itself, whatever the list says.
    let keeps = (1..=2)
        .map(|sub| format!("[[fault]]\nkind = \"sdo-ignored\"\nindex = 0xf030\nsub = {sub}\n"));
    let keeps: String = keeps.collect();
    let refuses = "[[fault]]\nkind = \"refuse-state\"\nstate = \"safe-op\"\ncode = 0x70\n";
    let difference = "it detects the modules [OUT8, IN8] (0xF050), the file configures [IN8, OUT8]";
    for (script, is_refused) in [(keeps.clone() + refuses, true), (keeps, false)] {
        let options = shortly(&script);
        options.clock.enter();
        let bus = simulated_bus(&plugged, 1, options.faults.as_ref(), None).expect("a bus");
        let mut heard = Heard::default();
        let link = Box::new(SimLink::new(bus));
        let stop = Arc::<CancelToken>::default();
        let outcome = session::run_on(link, file.clone(), options, stop, &mut heard);
        let error = outcome.result.err().map(|error| error.to_string());
        if is_refused {
            let error = error.expect("it refuses SafeOp");
            assert!(error.contains(difference), "{error}");
            assert!(error.contains("0x0070"), "{error}");
        } else {
            let warnings = heard.warnings();
            assert!(
                warnings.iter().any(|w| w.contains(difference)),
                "{warnings:?} {error:?}"
            );
        }
    }
}

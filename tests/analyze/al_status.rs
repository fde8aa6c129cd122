//! AL status, acknowledgements and mailboxes in hand-made recordings.

use ecaxis_tools::analyze::{Context, Report};

use super::analyzed;

const FPRD: u8 = 4;
const FPWR: u8 = 5;
const BRD: u8 = 7;
const STATION: u16 = 0x1001;
const AL_CONTROL: u16 = 0x0120;
const AL_STATUS: u16 = 0x0130;
const AL_STATUS_CODE: u16 = 0x0134;
const SAFE_OP: u8 = 4;
const OP: u8 = 8;
const ERROR: u8 = 0x10;
const SYNC_MANAGER_WATCHDOG: u8 = 0x1b;

/// A datagram with its answer: command, ADP, ADO, sent and received data, working counter.
type Datagram = (u8, u16, u16, Vec<u8>, Vec<u8>, u16);

fn read(register: u16, data: &[u8]) -> Datagram {
    let sent = vec![0; data.len()];
    (FPRD, STATION, register, sent, data.to_vec(), 1)
}

fn write(register: u16, data: &[u8]) -> Datagram {
    (FPWR, STATION, register, data.to_vec(), data.to_vec(), 1)
}

fn broadcast(register: u16, data: &[u8], devices: u16) -> Datagram {
    let sent = vec![0; data.len()];
    (BRD, 0, register, sent, data.to_vec(), devices)
}

fn ethernet(datagrams: &[Datagram], answer: bool) -> Vec<u8> {
    let mut frame = vec![0xff; 6];
    frame.extend([
        if answer { 0x12 } else { 0x10 },
        0x10,
        0x10,
        0x10,
        0x10,
        0x10,
    ]);
    frame.extend([0x88, 0xa4]);
    let mut body = Vec::new();
    for (n, (command, adp, ado, sent, back, wkc)) in datagrams.iter().enumerate() {
        let data = if answer { back } else { sent };
        let more = u16::from(n + 1 < datagrams.len()) << 15;
        body.extend([*command, n as u8]);
        for word in [*adp, *ado, data.len() as u16 | more, 0] {
            body.extend(word.to_le_bytes());
        }
        body.extend(data);
        body.extend(if answer { *wkc } else { 0 }.to_le_bytes());
    }
    frame.extend((body.len() as u16 | 0x1000).to_le_bytes());
    frame.extend(body);
    frame.resize(frame.len().max(60), 0);
    frame
}

/// Analyzes a recording (pcap) with one frame and its answer per millisecond.
fn report(frames: &[Vec<Datagram>]) -> Report {
    let mut file = Vec::new();
    for word in [0xa1b2_c3d4_u32, 0x0004_0002, 0, 0, 65_535, 1] {
        file.extend(word.to_le_bytes());
    }
    for (n, datagrams) in (0..).zip(frames) {
        for answer in [false, true] {
            let bytes = ethernet(datagrams, answer);
            let microseconds = n * 1000 + 20 * u32::from(answer);
            for word in [1, microseconds, bytes.len() as u32, bytes.len() as u32] {
                file.extend(word.to_le_bytes());
            }
            file.extend(bytes);
        }
    }
    analyzed(&file, Context::default())
}

/// Returns time in milliseconds and text of the problems.
fn troubles(frames: &[Vec<Datagram>]) -> Vec<(u64, String)> {
    let report = report(frames);
    let lines = report.events.iter().filter(|line| line.trouble);
    let line = lines.map(|line| ((line.at * 1e3 + 0.1) as u64, line.text.clone()));
    line.collect()
}

/// ETG.1000.6 clause 6.4.1: the error bit lasts until the device has processed the acknowledgement.
/// SOEM and ethercrab write AL control and read AL status in the same frame.
#[test]
fn an_error_acknowledged_in_the_same_frame_is_not_a_new_error() {
    let status = |status: u8| read(AL_STATUS, &[status, 0]);
    let code = || read(AL_STATUS_CODE, &[SYNC_MANAGER_WATCHDOG, 0]);
    let acknowledge = || write(AL_CONTROL, &[SAFE_OP | ERROR, 0]);
    let found = troubles(&[
        vec![status(OP)],
        vec![status(SAFE_OP | ERROR)],
        vec![code()],
        vec![acknowledge(), status(SAFE_OP | ERROR)],
        vec![status(SAFE_OP | ERROR), code()],
        vec![status(SAFE_OP)],
    ]);
    assert_eq!(found.len(), 1, "{found:?}");
    assert_eq!(found[0].0, 1);
    assert!(
        found[0].1.starts_with("SafeOp with error 0x001b"),
        "{found:?}"
    );
    // An error from before the recording.
    let found = troubles(&[
        vec![acknowledge(), status(SAFE_OP | ERROR), code()],
        vec![status(SAFE_OP)],
    ]);
    assert_eq!(found, []);
}

/// ETG.1000.6 clause 6.4.1: a refused request sets the error bit. MainDevices observe it with a
/// broadcast read, and read the AL status of each device later.
#[test]
fn a_refused_state_change_is_reported_when_it_appears() {
    let frames = [
        vec![broadcast(AL_STATUS, &[SAFE_OP, 0], 2)],
        vec![read(AL_STATUS, &[SAFE_OP, 0])],
        vec![write(AL_CONTROL, &[OP, 0])],
        vec![broadcast(AL_STATUS, &[SAFE_OP | ERROR, 0], 2)],
        vec![broadcast(AL_STATUS, &[SAFE_OP | ERROR, 0], 2)],
        vec![read(AL_STATUS, &[SAFE_OP | ERROR, 0, 0, 0, 0x1d, 0])],
    ];
    let found = troubles(&frames);
    assert_eq!(found.len(), 1, "{found:?}");
    assert_eq!(found[0].0, 3);
    assert!(found[0].1.starts_with("SafeOp with error 0x001d"));
    // The device is never read.
    let found = troubles(&frames[..5]);
    assert_eq!(found, [(3, "a device reports an error".to_owned())]);
    // Also after a state that was reached with an acknowledgement.
    let found = troubles(&[
        vec![write(AL_CONTROL, &[SAFE_OP | ERROR, 0])],
        vec![read(AL_STATUS, &[SAFE_OP, 0])],
        vec![read(AL_STATUS, &[SAFE_OP | ERROR, 0])],
    ]);
    assert_eq!(found, [(2, "SafeOp with an error".to_owned())]);
}

/// ETG.1000.4, mailbox header: type 2 is EoE; ETG.1000.6 clause 5.7: fragment 0 of an EoE frame.
#[test]
fn eoe_mailboxes_are_counted() {
    let mut message = vec![8, 0, 0, 0, 0, 0x12, 0, 0, 0, 0, 1, 2, 3, 4];
    message.resize(48, 0);
    let mut second = message.clone();
    second[5] = 0x22;
    let report = report(&[
        vec![read(AL_STATUS, &[SAFE_OP, 0])],
        vec![write(0x1000, &message)],
        vec![read(0x1080, &second)],
    ]);
    let counted: Vec<_> = report.devices[0].mailbox_messages.iter().collect();
    assert_eq!(counted, [(&"EoE", &2)]);
    let text = ecaxis_tools::analyze::document("x", &report, &[], false).text(None);
    assert!(text.contains("Mailbox messages, not decoded"), "{text}");
}

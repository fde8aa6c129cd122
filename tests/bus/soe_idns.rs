//! IDNs of a Sercos drive during operation and at start-up.

use std::fmt::Write as _;
use std::time::Duration;

use ecaxis_ecat::mailbox::soe::{
    Attribute, ERROR_CODES, Element, Idn, List, Message, format_value,
};
use ecaxis_master::mailbox::{IdnElement, MailboxError, Mailboxes};
use ecaxis_master::session::Options;
use ecaxis_test_support::recordings::{FPRD, FPWR, frames};
use ecaxis_test_support::{
    Heard, assert_contains, faults, load, recorded, run_badly, run_well, skip, virtual_time,
};

use crate::mailboxes::with_user_of;

/// Runs the sample machine at rest until the user is done.
fn with_user<F>(options: Options, user: F) -> Heard
where
    F: AsyncFnOnce(Mailboxes) + Send + 'static,
{
    let (outcome, heard) = with_user_of(load("sercos.toml"), options, user);
    outcome.result.expect("an undisturbed run");
    heard
}

/// Returns the value of a list of numbers.
fn list_of(numbers: impl Iterator<Item = i32>) -> Vec<u8> {
    let data: Vec<u8> = numbers.flat_map(i32::to_le_bytes).collect();
    let max = u16::try_from(data.len()).expect("short");
    [&List { max, data: &data }.header()[..], &data].concat()
}

/// Returns the elements of a list.
fn data(list: &[u8]) -> &[u8] {
    List::parse(list).expect("a list").data
}

fn code(result: Result<impl std::fmt::Debug, MailboxError>) -> u16 {
    match result {
        Err(MailboxError::Sdo { source, .. }) => source.soe_code().expect("an SoE code"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn idns_are_read_and_written_during_operation() {
    with_user(virtual_time(), async |mailboxes| {
        let mailbox = mailboxes.device("sercos").expect("it is there");
        let at = |idn: &str| IdnElement::value(1, idn.parse().expect("an IDN"));
        // A list of 1,024 numbers, in fragments both ways.
        let list = list_of((0..1024).map(|n| n * n - 7));
        let table = at("P-0-0100");
        for _ in 0..3 {
            mailbox.write_idn(table, &list).await.expect("written");
            let read = mailbox.read_idn(table).await.expect("read");
            assert_eq!(data(&read), data(&list));
        }
        let attribute = mailbox
            .read_idn(table.with(Element::Attribute))
            .await
            .expect("read");
        let attribute = Attribute(u32::from_le_bytes(
            attribute[..4].try_into().expect("4 bytes"),
        ));
        assert_eq!(attribute.to_string(), "list of 4 bytes each, signed");
        let text = format_value(attribute, &list);
        assert!(
            text.starts_with("-7, -6, -3, 2") && text.ends_with("1046522"),
            "{text}"
        );
        // One more element than the drive holds.
        let longer = list_of(0..1025);
        assert_eq!(code(mailbox.write_idn(table, &longer).await), 0x7003);
        // The start-up IDNs have set both drives: 1 ms, position control, 1500.000 rpm.
        for drive in 0..2 {
            let read = async |idn| {
                mailbox
                    .read_idn(IdnElement::value(drive, idn))
                    .await
                    .expect("read")
            };
            assert_eq!(read(Idn::OPERATION_MODE).await, [0x0b, 0]);
            assert_eq!(read(Idn::MDT_LIST).await, [2, 0, 24, 0, 47, 0]);
            assert_eq!(read(Idn::AT_LIST).await, [4, 0, 24, 0, 51, 0, 189, 0]);
            assert_eq!(read(Idn::standard(91)).await, 1_500_000_u32.to_le_bytes());
        }
        for idn in [Idn::CONTROL_CYCLE, Idn::COMMUNICATION_CYCLE] {
            let cycle = mailbox
                .read_idn(IdnElement::value(0, idn))
                .await
                .expect("read");
            assert_eq!(cycle, 1000_u16.to_le_bytes());
        }
        // What the drive refuses.
        let word = |idn: &str| mailbox.write_idn(at(idn), &[1, 0]);
        assert_eq!(code(mailbox.read_idn(at("S-0-0999")).await), 0x1001);
        assert_eq!(code(word("S-0-0135").await), 0x7004);
        assert_eq!(code(word("S-0-0015").await), 0x7005);
        assert_eq!(code(word("S-0-0134").await), 0x700a);
        assert_eq!(code(word("S-0-0091").await), 0x7002);
        assert_eq!(code(word("P-0-0102").await), 0x7009);
        assert_eq!(
            code(mailbox.read_idn(IdnElement::value(2, Idn(1))).await),
            0x800a
        );
        let high = 10_000_001_u32.to_le_bytes();
        assert_eq!(code(mailbox.write_idn(at("S-0-0091"), &high).await), 0x7007);
        let unit = at("S-0-0011").with(Element::Unit);
        assert_eq!(code(mailbox.read_idn(unit).await), 0x4001);
        // A procedure command without an error to clear.
        let reset = (1, Idn::RESET_CLASS_1);
        let done = mailbox.execute_command(reset, Duration::from_secs(1)).await;
        done.expect("executed");
        let state = mailbox
            .read_idn(at("S-0-0099").with(Element::DataState))
            .await;
        assert_eq!(state.expect("read"), [0, 0], "it is cleared again");
        // SoE and CoE do not mix.
        assert!(mailbox.upload(0x1018, 1).await.is_err());
    });
}

/// Lost frames repeat no write and lose no fragment.
#[test]
fn lists_survive_lost_frames() {
    let script = "[[fault]]\nkind = \"frame-loss\"\nprobability = 0.01\nat = \"1s\"\n";
    let machine_options = faults(script);
    with_user(machine_options, async |mailboxes| {
        let mailbox = mailboxes.device("sercos").expect("it is there");
        let table = IdnElement::value(0, Idn::product(100));
        for round in 0..20_i32 {
            let list = list_of((0..1000).map(|n| n ^ round));
            mailbox.write_idn(table, &list).await.expect("written");
            let read = mailbox.read_idn(table).await.expect("read");
            assert_eq!(data(&read), data(&list));
        }
    });
}

/// ETG.1000.6, table of SoE error codes: every code arrives with its text, IDN, drive and name.
#[test]
fn every_error_code_is_reported_with_its_text() {
    let codes = || ERROR_CODES.iter().filter(|(code, _)| *code != 0);
    let mut script = String::new();
    for (n, (code, _)) in (0..).zip(codes()) {
        let idn = 0x8000 | (1000 + n);
        let _ = write!(
            script,
            "[[fault]]\nkind = \"sdo-abort\"\ndevice = 0\nindex = {idn:#06x}\nsub = 1\ncode = {code:#x}\nat = \"0s\"\n"
        );
    }
    with_user(faults(&script), async move |mailboxes| {
        let mailbox = mailboxes.device("sercos").expect("it is there");
        for (n, (expected, text)) in (0..).zip(codes()) {
            let at = IdnElement::value(1, Idn::product(1000 + n));
            let error = mailbox
                .read_idn(at)
                .await
                .expect_err("it refuses")
                .to_string();
            let idn = format!("P-0-{:04} of drive 1", 1000 + n);
            let code = format!("{expected:#06x}: {text}");
            assert_contains(&error, &["`sercos`", &idn, &code]);
        }
    });
}

/// A start-up IDN that the drive refuses names device, IDN with name, value, origin, code and text.
#[test]
fn a_refused_start_up_idn_is_named() {
    let script = "[[fault]]\nkind = \"sdo-abort\"\ndevice = 0\nindex = 32\nsub = 1\ncode = 0x7008\nat = \"0s\"\n";
    let (error, _) = run_badly(load("sercos.toml"), faults(script));
    println!("{error}");
    assert_contains(
        &error,
        &[
            "`sercos`",
            "S-0-0032 (Primary operation mode) of drive 1",
            "[0b 00]",
            "InitCmd",
            "0x7008",
        ],
    );
}

/// One SoE header: operation, "incomplete", "error", drive, IDN or fragments left.
type Header = (u8, bool, bool, u8, u16);

/// Wireshark's dissector reads the same headers from a recorded start-up as our codec. Without
/// tshark, the test is skipped.
#[test]
fn tshark_reads_the_same_messages() {
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(virtual_time(), folder.path());
    run_well(load("sercos.toml"), options);
    let mut arguments = vec!["-r".to_owned(), path.display().to_string()];
    arguments.extend(
        [
            "-Y",
            "ecat_mailbox.soe_opcode",
            "-T",
            "fields",
            "-E",
            "separator=|",
        ]
        .map(String::from),
    );
    for field in [
        "opcode",
        "header_incomplete",
        "header_error",
        "header_driveno",
        "idn",
        "frag",
    ] {
        arguments.extend(["-e".to_owned(), format!("ecat_mailbox.soe_{field}")]);
    }
    let output = match std::process::Command::new("tshark")
        .args(&arguments)
        .output()
    {
        Ok(output) => output,
        Err(error) => return skip(&format!("no tshark: {error}")),
    };
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let number = |text: &str| match text.strip_prefix("0x") {
        Some(hex) => u16::from_str_radix(hex, 16).expect("hex"),
        None => text.parse().expect("a number"),
    };
    let flag = |text: &str| matches!(text, "1" | "True");
    let mut dissected: Vec<Header> = Vec::new();
    for line in String::from_utf8(output.stdout).expect("UTF-8").lines() {
        let fields: Vec<Vec<&str>> = line
            .split('|')
            .map(|field| field.split(',').collect())
            .collect();
        for (n, operation) in fields[0].iter().enumerate() {
            let of = |field: usize| fields[field].get(n).copied().unwrap_or_default();
            let word = if of(4).is_empty() { of(5) } else { of(4) };
            dissected.push((
                number(operation) as u8,
                flag(of(1)),
                flag(of(2)),
                number(of(3)) as u8,
                number(word),
            ));
        }
    }
    let mut own: Vec<Header> = Vec::new();
    for frame in frames(&path) {
        for datagram in &frame.datagrams {
            // The mailboxes of the ESI.
            let mailbox = matches!(datagram.register(), 0x1800 | 0x1a00)
                && matches!(datagram.command, FPRD | FPWR);
            if let (true, Ok(Message::Telegram(soe))) = (mailbox, Message::parse(&datagram.data)) {
                own.push((
                    soe.operation.bits(),
                    soe.incomplete,
                    soe.error,
                    soe.drive,
                    soe.idn_or_left,
                ));
            }
        }
    }
    println!("{} SoE headers", own.len());
    assert!(own.len() >= 40, "{}", own.len());
    assert_eq!(dissected, own);
}

//! Tests of valid scripts and of the errors of invalid ones.

use super::keys::al_state;
use super::script::*;
use crate::drive::State;
use crate::esc::al::AlState;
use crate::esc::ports::Medium;
use crate::gateway::GatewayFault;
use crate::network::topology::Topology;

#[test]
fn script_with_every_kind_parses() {
    let script = FaultScript::parse(
        r#"
        seed = 9
        [[fault]]
        at = "1.5s"
        for = "20ms"
        kind = "frame-loss"
        count = 3
        [[fault]]
        device = 1
        kind = "drive-fault"
        code = 0x8611
        [[fault]]
        kind = "sdo-abort"
        index = 0x6065
        code = 0x06010002
        [[fault]]
        kind = "refuse-state"
        state = "safeop"
        code = 0x001e
        [[fault]]
        kind = "stuck"
        state = "switch-on-disabled"
        [[fault]]
        kind = "identity"
        product = 5
        [[fault]]
        kind = "absent"
        [[fault]]
        kind = "silent"
        [[fault]]
        kind = "emergency"
        code = 0x2310
        [[fault]]
        device = 3
        kind = "link-break"
        port = 1
        [[fault]]
        kind = "node-silent"
        node = 5
        [[fault]]
        kind = "heartbeat-lost"
        node = 6
        [[fault]]
        kind = "node-error"
        node = 7
        [[fault]]
        kind = "can-open"
        [[fault]]
        kind = "gateway-reset"
        [[fault]]
        kind = "control-ignored"
        [[fault]]
        kind = "power-off"
        [[fault]]
        kind = "frame-duplicate"
        probability = 0.25
        [[fault]]
        kind = "frame-delay"
        count = 2
        delay = "1.5ms"
        [[fault]]
        kind = "frame-corrupt"
        count = 1
        [[fault]]
        kind = "frame-corrupt"
        count = 1
        device = 2
        port = 3
        [[fault]]
        kind = "swap"
        serial = 9
        [[fault]]
        kind = "sdo-ignored"
        index = 0x60c2
        sub = 1
        [[fault]]
        kind = "mailbox-silent"
        [[fault]]
        kind = "sync-late"
        delay = "20s"
        [[fault]]
        kind = "clock-ignored"
        [[fault]]
        kind = "other-main-device"
        count = 1
        state = "init"
        [[fault]]
        kind = "other-main-device"
        probability = 0.5
        [[fault]]
        kind = "watchdog"
        "#,
    )
    .unwrap();
    assert_eq!(script.seed, Some(9));
    let kinds: Vec<FaultKind> = script.faults.iter().map(|f| f.kind.clone()).collect();
    let one = FrameSelection::Next(1);
    let expected = [
        FaultKind::FrameLoss {
            hits: FrameSelection::Next(3),
        },
        FaultKind::DriveFault { code: 0x8611 },
        FaultKind::SdoAbort {
            index: 0x6065,
            sub: 0,
            code: 0x0601_0002,
        },
        FaultKind::RefuseState {
            state: AlState::SafeOp,
            code: 0x1e,
        },
        FaultKind::Stuck {
            state: State::SwitchOnDisabled,
        },
        FaultKind::Identity(NewIdentity {
            product: Some(5),
            ..NewIdentity::default()
        }),
        FaultKind::PowerOff,
        FaultKind::Silent,
        FaultKind::Emergency { code: 0x2310 },
        FaultKind::LinkBreak { port: 1 },
        FaultKind::Gateway(GatewayFault::NodeSilent(5)),
        FaultKind::Gateway(GatewayFault::HeartbeatLost(6)),
        FaultKind::Gateway(GatewayFault::NodeError(7)),
        FaultKind::Gateway(GatewayFault::CanOpen),
        FaultKind::Gateway(GatewayFault::Reset),
        FaultKind::Gateway(GatewayFault::ControlIgnored),
        FaultKind::PowerOff,
        FaultKind::FrameDuplicate {
            hits: FrameSelection::Each(0.25),
        },
        FaultKind::FrameDelay {
            hits: FrameSelection::Next(2),
            delay: 1_500_000,
        },
        FaultKind::FrameCorrupt {
            hits: one,
            at: None,
        },
        FaultKind::FrameCorrupt {
            hits: one,
            at: Some((2, 3)),
        },
        FaultKind::Swap(NewIdentity {
            serial: Some(9),
            alias: Some(0),
            ..NewIdentity::default()
        }),
        FaultKind::SdoIgnored {
            index: 0x60c2,
            sub: 1,
        },
        FaultKind::MailboxSilent,
        FaultKind::SyncLate {
            delay: 20_000_000_000,
        },
        FaultKind::ClockIgnored,
        FaultKind::OtherMainDevice {
            hits: one,
            state: Some(AlState::Init),
        },
        FaultKind::OtherMainDevice {
            hits: FrameSelection::Each(0.5),
            state: None,
        },
        FaultKind::Watchdog,
    ];
    assert_eq!(kinds, expected);
    assert_eq!(script.faults[0].at, 1_500_000_000);
    assert_eq!(script.faults[0].duration, Some(20_000_000));
    assert_eq!(script.faults[9].device, 3);
}

#[test]
fn script_errors_name_line_and_field() {
    let error = |text: &str| FaultScript::parse(text).unwrap_err().to_string();
    assert_eq!(
        error("[[fault]]\nkind = \"sdo-abort\"\ncode = 1\n"),
        "line 2: fault of kind `sdo-abort`: `index` is missing"
    );
    #[rustfmt::skip] // one row a mistake
    let rows = [
        ("kind = \"absent\"\ncode = 1\n", "`code` is unknown here; known: `device`"),
        ("kind = \"silent\"\ndevice = 1\n", "`device` is unknown here: this kind takes no keys"),
        ("kind = \"frame-loss\"\ndevice = 1\ncount = 1\n", "`device` is unknown here"),
        ("kind = \"link-break\"\nport = 4\n", "ports are 0 to 3"),
        ("kind = \"melt\"\n", "known are frame-loss, frame-duplicate, frame-delay, frame-corrupt, drive-fault"),
        ("kind = \"frame-duplicate\"\n", "needs either `count` or `probability`"),
        ("kind = \"frame-corrupt\"\ncount = 1\nprobability = 0.5\n", "needs either"),
        ("kind = \"frame-corrupt\"\ncount = 1\nport = 1\n", "`port` needs the `device`"),
        ("kind = \"frame-corrupt\"\nprobability = 1.5\n", "between 0 and 1"),
        ("kind = \"frame-delay\"\ncount = 1\n", "`delay` is missing"),
        ("kind = \"frame-delay\"\ncount = 1\ndelay = \"1\"\n", "not a duration"),
        ("kind = \"statusword\"\n", "`value` is missing"),
        ("kind = \"statusword\"\nvalue = 0x12345\n", "does not fit 16 bits"),
        ("kind = \"zero-inputs\"\nvalue = 1\n", "`value` is unknown here; known: `device`, `count`"),
        ("kind = \"position-shift\"\n", "`value` (counts) is missing"),
        ("kind = \"sto\"\ncode = 1\n", "`code` is unknown here; known: `device`"),
        ("kind = \"swap\"\nstate = \"op\"\n", "`state` is unknown here; known: `device`, `vendor`"),
        ("kind = \"sync-late\"\n", "`delay` is missing"),
        ("kind = \"sdo-ignored\"\n", "`index` is missing"),
        ("kind = \"other-main-device\"\n", "needs either"),
        ("kind = \"mailbox-silent\"\nport = 1\n", "known: `device`"),
        ("at = \"soon\"\nkind = \"absent\"\n", "not a duration"),
        ("kind = \"silent\"\nwhen = 1\n", "when"),
    ];
    for (lines, expected) in rows {
        let reported = error(&format!("[[fault]]\n{lines}"));
        assert!(reported.contains(expected), "{lines}: {reported}");
    }
}

#[test]
fn al_state_accepts_common_spellings() {
    for (state, spellings) in [
        (AlState::Init, &["init", "Init", "INIT"][..]),
        (AlState::PreOp, &["PreOp", "pre-op", "preop", "PRE-OP"]),
        (AlState::SafeOp, &["SafeOp", "safe-op", "safeop", "Safe-Op"]),
        (AlState::Op, &["Op", "op", "OP"]),
        (AlState::Boot, &["boot", "Boot"]),
    ] {
        for spelling in spellings {
            assert_eq!(al_state(spelling), Ok(state), "{spelling}");
        }
    }
    assert_eq!(
        al_state("Running").unwrap_err(),
        "`Running` is not init, preop, boot, safeop or op"
    );
}

#[test]
fn check_names_a_missing_device_and_its_line() {
    let script = FaultScript::parse(
        "[[fault]]\nkind = \"silent\"\n\n[[fault]]\ndevice = 2\nkind = \"absent\"\n",
    )
    .unwrap();
    let lines: Vec<u32> = script.faults.iter().map(|fault| fault.line).collect();
    assert_eq!(lines, [2, 6]);
    let line = |n: usize| Topology::by_order(&vec![Medium::from_physics("YY"); n]).unwrap();
    assert_eq!(script.check(&line(3)), Ok(()));
    assert_eq!(
        script.check(&line(2)).unwrap_err().to_string(),
        "line 6: there is no device 2; the bus has 2, counted from 0"
    );
    let silent = FaultScript::parse("[[fault]]\nkind = \"silent\"\n").unwrap();
    assert_eq!(silent.check(&line(0)), Ok(()));
    for (device, port, cable) in [(0, 0, true), (1, 1, true), (2, 0, true), (2, 1, false)] {
        let script =
            format!("[[fault]]\nkind = \"link-break\"\ndevice = {device}\nport = {port}\n");
        let reported = FaultScript::parse(&script).unwrap().check(&line(3));
        assert_eq!(reported.is_ok(), cable, "device {device} port {port}");
    }
    let nowhere = "[[fault]]\nkind = \"frame-corrupt\"\ncount = 1\ndevice = 1\nport = 2\n";
    assert_eq!(
        FaultScript::parse(nowhere)
            .unwrap()
            .check(&line(3))
            .unwrap_err()
            .to_string(),
        "line 2: nothing is connected to port 2 of device 1"
    );
}

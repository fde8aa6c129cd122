//! Random input: the simulator neither panics nor hangs nor returns a wrong length.
//!
//! `ECAXIS_FUZZ_FRAMES` sets the number of random frames, e.g. 10 million:
//! `ECAXIS_FUZZ_FRAMES=10000000 cargo test --release -p ecaxis-sim --test main fuzz::frames --
//! --nocapture`

#[path = "common/hostile/mod.rs"]
mod hostile;

use ecaxis_sim::{DeviceOptions, FaultScript, SimDevice, Topology};
use hostile::{Dice, Hostile};
use proptest::prelude::*;

/// The bus is rebuilt after this number of attacks.
const ROUNDS: u64 = 500;

#[test]
fn random_frames_come_back_whole() {
    let wanted = std::env::var("ECAXIS_FUZZ_FRAMES").ok();
    let wanted = wanted.map_or(30_000, |n| n.parse().expect("a number of frames"));
    let mut hostile = Hostile::new(1);
    let mut frames = 0;
    while frames < wanted {
        for _ in 0..ROUNDS.min(wanted - frames) {
            hostile.attack();
            frames += 1;
        }
        hostile.rebuild();
    }
    eprintln!(
        "{frames} random frames: {} answered, {} with a working counter, {} with a device in Op, {} buses",
        hostile.answered, hostile.processed, hostile.in_op, hostile.rebuilt,
    );
    // Frames that no device processes test nothing.
    assert!(hostile.processed > frames / 4);
    assert!(hostile.in_op > frames / 4);
}

/// Keys and words of a script, valid and invalid.
const KEYS: &[&str] = &[
    "at",
    "for",
    "device",
    "kind",
    "count",
    "probability",
    "code",
    "index",
    "sub",
    "state",
    "vendor",
    "product",
    "revision",
    "port",
    "delay",
    "serial",
    "alias",
    "value",
    "mask",
    "with",
];
const KINDS: &[&str] = &[
    "frame-loss",
    "drive-fault",
    "sdo-abort",
    "refuse-state",
    "stuck",
    "identity",
    "absent",
    "silent",
    "emergency",
    "link-break",
    "power-off",
    "swap",
    "frame-duplicate",
    "frame-corrupt",
    "frame-delay",
    "sdo-ignored",
    "mailbox-silent",
    "sync-late",
    "watchdog",
    "other-main-device",
    "statusword",
    "zero-inputs",
    "position-shift",
    "sto",
    "enable-input",
    "melt",
];
const STATES: &[&str] = &[
    "init",
    "PreOp",
    "safe-op",
    "op",
    "boot",
    "fault",
    "switched-on",
    "",
];
const TIMES: &[&str] = &[
    "0ns",
    "1ms",
    "7.5ms",
    "20ms",
    "1s",
    "-1s",
    "1e300s",
    "ms",
    "99999999min",
];

fn value(dice: &mut Dice) -> String {
    match dice.below(8) {
        0 => format!("{:?}", dice.pick(STATES)),
        1 => format!("{:?}", dice.pick(TIMES)),
        2 => format!("{}", dice.below(100) as f64 / 50.0),
        3 => dice
            .pick(&["-1", "nan", "inf", "true", "[1]", "{}", "1979-05-27"])
            .to_owned(),
        4 => format!("{}", dice.roll() >> 1),
        5 => format!("0x{:04x}", dice.roll() as u16),
        _ => format!("{}", dice.below(10)),
    }
}

/// Returns a script whose faults mostly have the keys of their kind.
fn script(dice: &mut Dice) -> String {
    let mut text = String::new();
    if dice.percent(50) {
        text += &format!("seed = {}\n", dice.roll() >> 1);
    }
    for _ in 0..dice.below(4) {
        text += &format!("[[fault]]\nkind = {:?}\n", dice.pick(KINDS));
        let mut keys = KEYS.to_vec();
        keys.retain(|key| *key != "kind");
        for _ in 0..dice.below(4) {
            let key = keys.swap_remove(dice.below(keys.len()));
            let value = match key {
                "at" | "for" | "delay" if dice.percent(80) => format!("{:?}", dice.pick(TIMES)),
                "state" if dice.percent(80) => format!("{:?}", dice.pick(STATES)),
                _ => value(dice),
            };
            text += &format!("{key} = {value}\n");
        }
    }
    text
}

/// Returns the script if the bus can run it.
fn runnable(text: &str, bus: &Topology) -> Option<FaultScript> {
    let script = FaultScript::parse(text).ok()?;
    script.check(bus).ok()?;
    Some(script)
}

#[test]
fn random_fault_scripts_are_refused_or_run() {
    let mut hostile = Hostile::new(2);
    let (mut ran, mut refused) = (0, 0);
    for _ in 0..3_000 {
        let text = script(&mut hostile.dice);
        let Some(script) = runnable(&text, hostile.bus.segment.topology()) else {
            refused += 1;
            continue;
        };
        ran += 1;
        hostile.rebuild_with(script);
        for _ in 0..50 {
            hostile.attack();
        }
    }
    eprintln!("{ran} fault scripts run, {refused} refused");
    assert!(ran > 100 && refused > 100);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 128, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn fault_script_parser_survives_any_text(text in ".{0,200}") {
        let _ = FaultScript::parse(&text);
    }

    /// Changes, cuts or extends the EEPROM image of one of the project's devices.
    #[test]
    fn eeprom_parser_survives_any_image(
        of in 0_usize..8,
        seed in any::<u64>(),
        changes in prop::collection::vec((0_usize..600, any::<u8>()), 0..20),
        len in prop_oneof![Just(None), (0_usize..3000).prop_map(Some)],
    ) {
        let mut hostile = Hostile::new(seed);
        let mut image = hostile.bus.segment.device(of).unwrap().sii().to_vec();
        for (at, value) in changes {
            if let Some(byte) = image.get_mut(at) {
                *byte = value;
            }
        }
        if let Some(len) = len {
            image.resize(len, 0xff);
        }
        if let Ok(device) = SimDevice::from_sii(&image, DeviceOptions::default()) {
            hostile.replace(of, device);
            for _ in 0..100 {
                hostile.attack();
            }
        }
    }
}

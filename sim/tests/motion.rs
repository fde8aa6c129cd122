//! A drive's behaviour over the bus, as its MainDevice sees it.

use crate::common::*;
use ecaxis_sim::drive::{State, input};
use ecaxis_sim::{DeviceOptions, FaultScript, PlantParams, Quirks, SimDevice, Track};

const EPOS4: &str = "esi/maxon/maxon_motor_EPOS4_0170h_6950h_0000h_0000h_ESI.xml";
const VALUE_RANGE: u32 = 0x0609_0030;

/// The smallest dictionary, with the objects that every drive adds.
fn drive() -> SimDevice {
    let mut device = coe_device();
    device.profile = Some(402);
    sim(&device)
}

#[test]
fn option_codes_outside_the_standard_are_refused() {
    let mut bus = Bus::new(vec![drive()]);
    bus.address_all();
    bus.preop(0x1001);
    let rows = [
        (0x605a, 0..=8),
        (0x605b, 0..=1),
        (0x605c, 0..=1),
        (0x605e, 0..=4),
        (0x6007, 0..=3),
    ];
    for (index, known) in rows {
        for code in [-32_768_i16, -1, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 0x100, 0x7fff] {
            let answer = bus.download(0x1001, index, 0, &code.to_le_bytes());
            if known.contains(&code) {
                answer.unwrap();
                let value = bus.upload(0x1001, index, 0).unwrap();
                assert_eq!(value, code.to_le_bytes());
            } else {
                let refusal = answer.unwrap_err();
                assert_eq!(
                    refusal,
                    Refusal::Abort(VALUE_RANGE),
                    "0x{index:04x} = {code}"
                );
            }
        }
    }
    for method in i8::MIN..=i8::MAX {
        let known = [-4, -3, -2, -1, 1, 2, 7, 11, 17, 18, 23, 27, 33, 34, 35, 37].contains(&method);
        let answer = bus.download(0x1001, 0x6098, 0, &method.to_le_bytes());
        assert_eq!(answer.is_ok(), known, "homing method {method}");
    }
}

#[test]
fn epos4_lists_its_homing_methods() {
    let Some(xml) = fixture(EPOS4) else {
        return;
    };
    let file = ecaxis_esi::parse(&xml).unwrap();
    let options = DeviceOptions::default();
    let device = SimDevice::from_esi(&file.devices[0], &file.modules, options).unwrap();
    let count = device.object(0x60e3, 0).unwrap()[0];
    let mut listed: Vec<i8> = (1..=count)
        .map(|sub| device.object(0x60e3, sub).unwrap()[0].cast_signed())
        .collect();
    listed.sort_unstable();
    assert_eq!(
        listed,
        [-4, -3, -2, -1, 1, 2, 7, 11, 17, 18, 23, 27, 33, 34, 37]
    );
}

#[test]
fn inputs_and_outputs_are_wired_to_the_device() {
    let mut bus = Bus::new(vec![drive()]);
    bus.address_all();
    bus.preop(0x1001);
    let now = bus.now;
    let device = bus.segment.device_mut(0).unwrap();
    assert!(device.set_digital_input(now, input::HOME, true));
    assert!(device.set_digital_input(now, input::GENERAL + 3, true));
    bus.wait(1_000_000);
    let value = bus.upload(0x1001, 0x60fd, 0).unwrap();
    assert_eq!(value, 0x0008_0004_u32.to_le_bytes());
    bus.download(0x1001, 0x60fe, 1, &0x0001_0000_u32.to_le_bytes())
        .unwrap();
    let device = bus.segment.device_mut(0).unwrap();
    assert_eq!(device.digital_outputs(), Some(0x0001_0000));

    let mut terminal = sim(&coe_device());
    assert!(!terminal.set_digital_input(0, input::HOME, true));
    assert_eq!(terminal.digital_outputs(), None);
}

const STATION: u16 = 0x1001;
const CYCLE: u64 = 1_000_000;
/// The process data size of the CSP module in each direction.
const BYTES: u16 = 17;

/// An EPOS4 with the CSP module, and a MainDevice that exchanges process data every millisecond.
struct Axis {
    bus: Bus,
    outputs: Outputs,
    inputs: Inputs,
}

/// 0x6040, 0x607A, 0x6060, 0x60FE:01.
#[derive(Default)]
struct Outputs {
    controlword: u16,
    target: i32,
    mode: i8,
    digital: u32,
}

/// 0x6041, 0x6064, 0x6061, 0x60FD.
#[derive(Default)]
struct Inputs {
    statusword: u16,
    position: i32,
    mode: i8,
    digital: u32,
}

impl Axis {
    /// Returns the axis in SafeOp.
    fn new(track: Track) -> Option<Self> {
        Self::with(PlantParams {
            track,
            ..PlantParams::default()
        })
    }

    /// Returns a drive with one quirk, in SafeOp.
    fn with_quirk(key: &str, value: f64) -> Option<Self> {
        let mut quirks = Quirks::default();
        let quirk = Quirks::TABLE.iter().find(|quirk| quirk.key == key);
        quirk.unwrap().set(&mut quirks, value);
        Self::with(PlantParams {
            quirks,
            ..PlantParams::default()
        })
    }

    fn with(plant: PlantParams) -> Option<Self> {
        let file = ecaxis_esi::parse(&fixture(EPOS4)?).unwrap();
        let options = DeviceOptions {
            plant,
            ..DeviceOptions::default()
        };
        let device = SimDevice::from_esi(&file.devices[0], &file.modules, options).unwrap();
        let mut bus = Bus::new(vec![device]);
        bus.address_all();
        bus.preop(STATION);
        bus.download(STATION, 0x60c2, 1, &[1]).unwrap();
        bus.sm(STATION, 2, 0x1060, BYTES, 0x64);
        bus.sm(STATION, 3, 0x10f0, BYTES, 0x20);
        bus.fmmu(STATION, 0, 0, BYTES, 0x1060, 2);
        bus.fmmu(STATION, 1, 0, BYTES, 0x10f0, 1);
        bus.to(STATION, SAFEOP);
        Some(Self {
            bus,
            outputs: Outputs {
                mode: 8,
                ..Outputs::default()
            },
            inputs: Inputs::default(),
        })
    }

    fn cycle(&mut self) {
        let mut data = [0; BYTES as usize];
        data[..2].copy_from_slice(&self.outputs.controlword.to_le_bytes());
        data[2..6].copy_from_slice(&self.outputs.target.to_le_bytes());
        data[12] = self.outputs.mode.cast_unsigned();
        data[13..17].copy_from_slice(&self.outputs.digital.to_le_bytes());
        let next = self.bus.now + CYCLE;
        let (data, _) = self.bus.logical(12, 0, &data);
        self.inputs = Inputs {
            statusword: u16::from_le_bytes([data[0], data[1]]),
            position: i32::from_le_bytes(data[2..6].try_into().unwrap()),
            mode: data[12].cast_signed(),
            digital: u32::from_le_bytes(data[13..17].try_into().unwrap()),
        };
        self.bus.now = next;
    }

    fn cycles(&mut self, n: u32) {
        (0..n).for_each(|_| self.cycle());
    }

    /// Goes to Op, and to Operation enabled in the requested mode.
    fn enable(&mut self) {
        self.cycle();
        self.bus.request(STATION, 8);
        for controlword in [0x06, 0x07, 0x0f] {
            self.outputs.controlword = controlword;
            for _ in 0..10 {
                self.outputs.target = self.inputs.position;
                self.cycle();
            }
        }
        assert_eq!(self.inputs.statusword & 0x6f, 0x27);
        assert_eq!(self.inputs.mode, self.outputs.mode);
    }

    /// Begins faults now.
    fn begin(&mut self, script: &str) {
        let script = FaultScript::parse(script).unwrap();
        let now = self.bus.now;
        self.bus.segment.start_faults(script, now);
    }

    fn device(&mut self) -> &mut SimDevice {
        self.bus.segment.device_mut(0).unwrap()
    }
}

#[test]
fn process_data_acts_only_in_op() {
    let Some(mut axis) = Axis::new(Track::default()) else {
        return;
    };
    axis.outputs = Outputs {
        controlword: 0x06,
        mode: 9,
        digital: 0x0001_0000,
        target: 0,
    };
    axis.cycles(50);
    assert_eq!(axis.inputs.statusword & 0x26f, 0x40, "not remote");
    assert_ne!(axis.inputs.mode, 9);
    assert_eq!(axis.device().digital_outputs(), Some(0));
    axis.bus.request(STATION, 8);
    axis.cycles(50);
    assert_eq!(axis.inputs.statusword & 0x26f, 0x221, "remote");
    assert_eq!(axis.inputs.mode, 9);
    assert_eq!(axis.device().digital_outputs(), Some(0x0001_0000));
    axis.bus.request(STATION, 4);
    axis.outputs.digital = 0;
    axis.cycles(50);
    assert_eq!(axis.inputs.statusword & 0x26f, 0x40);
    assert_eq!(axis.device().digital_outputs(), Some(0x0001_0000));
}

#[test]
fn axis_homes_on_its_limit_switch_and_continues_in_csp() {
    let Some(mut axis) = Axis::new(Track {
        negative_limit: Some(-7000),
        index: Some(300),
        ..Track::default()
    }) else {
        return;
    };
    axis.bus.download(STATION, 0x6098, 0, &[1]).unwrap();
    for (sub, rpm) in [(1, 300_u32), (2, 60)] {
        axis.bus
            .download(STATION, 0x6099, sub, &rpm.to_le_bytes())
            .unwrap();
    }
    axis.bus
        .download(STATION, 0x30b0, 0, &1234_i32.to_le_bytes())
        .unwrap();
    axis.outputs.mode = 6;
    axis.enable();
    axis.outputs.controlword = 0x1f;
    axis.cycles(2);
    let mut struck = false;
    for n in 0.. {
        axis.cycle();
        struck |= axis.inputs.digital & 1 != 0;
        match axis.inputs.statusword & 0x3400 {
            0 => assert!(n < 10_000),
            word => {
                assert_eq!(word, 0x1400, "attained and reached");
                break;
            }
        }
    }
    assert!(struck);
    axis.cycles(100);
    assert!((axis.inputs.position - 1234).abs() <= 1);
    // The first index above −7000 is −5700.
    let moved = axis.device().drive().unwrap().position_counts() - 1234;
    assert!(moved.abs() <= 1);

    axis.outputs.mode = 8;
    axis.outputs.controlword = 0x0f;
    axis.outputs.target = axis.inputs.position;
    axis.cycles(10);
    assert_eq!(axis.inputs.mode, 8);
    for _ in 0..400 {
        axis.outputs.target += 10;
        axis.cycle();
    }
    axis.cycles(100);
    let off = axis.inputs.position - axis.outputs.target;
    assert!(off.abs() <= 3, "{off}");
    // Down again onto the switch: −7000 is now −66.
    for _ in 0..600 {
        axis.outputs.target -= 10;
        axis.cycle();
    }
    assert_eq!(axis.inputs.statusword & 0x4f, 0x08);
    let (kind, emergency) = axis.bus.fetch(STATION).expect("an emergency");
    assert_eq!((kind, &emergency[2..5]), (3, &[0x80, 0x8a, 0x21][..]));
    assert_eq!(
        axis.bus.upload(STATION, 0x603f, 0).unwrap(),
        0x8a80_u16.to_le_bytes()
    );
}

/// At 100 counts per millisecond a whole control cycle would be 40 counts.
#[test]
fn touch_probe_latches_the_position_at_the_edge() {
    let Some(mut axis) = Axis::new(Track::default()) else {
        return;
    };
    axis.enable();
    for n in 0..600_u32 {
        axis.outputs.target += i32::try_from(n.min(200)).unwrap() / 2;
        axis.cycle();
    }
    axis.bus
        .download(STATION, 0x60b8, 0, &0x11_u16.to_le_bytes())
        .unwrap();
    for (n, delay) in [130_000, 470_000, 10_000, 999_000].into_iter().enumerate() {
        let latched = |axis: &mut Axis| {
            let data = axis.bus.upload(STATION, 0x60ba, 0).unwrap();
            i32::from_le_bytes(data.try_into().unwrap())
        };
        let run = |axis: &mut Axis, cycles| {
            for _ in 0..cycles {
                axis.outputs.target += 100;
                axis.cycle();
            }
        };
        run(&mut axis, 400);
        let at = axis.bus.now - CYCLE + delay;
        axis.bus.segment.advance(at);
        let device = axis.device();
        assert!(device.set_digital_input(at, input::TOUCH_PROBE_1, true));
        run(&mut axis, 3);
        // The axis moves at constant speed: extrapolate from a later position back to the edge.
        let now = axis.bus.now;
        axis.bus.segment.advance(now);
        let position = axis.device().drive().unwrap().position_counts();
        let tick = now / 400_000 * 400_000;
        let back = (tick - at) as f64 * 1e-6 * 100.0;
        let off = f64::from(latched(&mut axis)) - (position as f64 - back);
        assert!(off.abs() <= 3.0, "{n}: off by {off}");
        for function in [0_u16, 0x11] {
            axis.device()
                .set_digital_input(now, input::TOUCH_PROBE_1, false);
            axis.bus
                .download(STATION, 0x60b8, 0, &function.to_le_bytes())
                .unwrap();
            axis.bus.now = axis.bus.now.next_multiple_of(CYCLE);
            run(&mut axis, 2);
        }
    }
    assert_eq!(
        axis.device().drive().unwrap().state(),
        State::OperationEnabled
    );
}

#[test]
fn all_inputs_are_zero_at_the_beginning_of_op() {
    let Some(mut axis) = Axis::with_quirk("zero_inputs", 10e6) else {
        return;
    };
    axis.cycles(5);
    assert_ne!(axis.inputs.statusword, 0);
    axis.bus.request(STATION, 8);
    let zero: Vec<bool> = (0..40)
        .map(|_| {
            axis.cycle();
            axis.inputs.statusword == 0 && axis.inputs.mode == 0
        })
        .collect();
    let count = zero.iter().filter(|zero| **zero).count();
    assert!((9..=11).contains(&count), "{zero:?}");
}

#[test]
fn a_written_home_position_is_confirmed_and_not_kept() {
    for (key, kept) in [("home_offset_not_kept", 0), ("home_offset_negated", 77)] {
        let Some(mut axis) = Axis::with_quirk(key, 1.0) else {
            return;
        };
        let written = 77_i32.to_le_bytes();
        axis.bus.download(STATION, 0x30b0, 0, &written).unwrap();
        let read = axis.bus.upload(STATION, 0x30b0, 0).unwrap();
        assert_eq!(read, i32::to_le_bytes(kept), "{key}");
    }
}

/// A client that writes 0x6040 by SDO enables the drive before Op.
#[test]
fn sdo_writes_to_the_controlword_act_before_op() {
    for (key, state) in [
        ("controlword_by_sdo", State::OperationEnabled),
        ("halt_ignored", State::SwitchOnDisabled),
    ] {
        let Some(mut axis) = Axis::with_quirk(key, 1.0) else {
            return;
        };
        for word in [0x06_u16, 0x07, 0x0f] {
            axis.bus
                .download(STATION, 0x6040, 0, &word.to_le_bytes())
                .unwrap();
            axis.bus.wait(10_000_000);
        }
        assert_eq!(axis.device().drive().unwrap().state(), state, "{key}");
    }
    // The Controlword of the last process data does not enable it again.
    let mut axis = Axis::with_quirk("controlword_by_sdo", 1.0).unwrap();
    axis.enable();
    axis.outputs.controlword = 0x06;
    axis.cycles(10);
    axis.bus.request(STATION, 4);
    axis.bus.wait(50_000_000);
    let state = axis.device().drive().unwrap().state();
    assert_eq!(state, State::SwitchOnDisabled);
}

#[test]
fn a_fault_shows_another_statusword_for_some_inputs() {
    let Some(mut axis) = Axis::new(Track::default()) else {
        return;
    };
    axis.enable();
    let usual = axis.inputs.statusword;
    let position = axis.inputs.position;
    for (keys, word, others) in [
        ("kind = 'statusword'\nvalue = 0x56", 0x56, true),
        (
            "kind = 'statusword'\nvalue = 0\nmask = 0x1000",
            usual & !0x1000,
            true,
        ),
        ("kind = 'zero-inputs'", 0, false),
    ] {
        axis.begin(&format!("[[fault]]\n{keys}\ncount = 2\n"));
        let seen: Vec<(u16, i8)> = (0..6)
            .map(|_| {
                axis.cycle();
                (axis.inputs.statusword, axis.inputs.mode)
            })
            .collect();
        let strange = (word, if others { 8 } else { 0 });
        let count = seen.iter().filter(|seen| **seen == strange).count();
        assert_eq!(count, 2, "{keys}: {seen:04x?}");
        assert_eq!(seen.last(), Some(&(usual, 8)), "{keys}");
        // The drive itself is not affected.
        assert_eq!(axis.inputs.position, position);
    }
    axis.begin("[[fault]]\nkind = 'statusword'\nvalue = 0\nfor = '10ms'\n");
    axis.cycles(8);
    assert_eq!(axis.inputs.statusword, 0);
    axis.cycles(8);
    assert_eq!(axis.inputs.statusword, usual);
}

#[test]
fn a_fault_shifts_all_positions() {
    let Some(mut axis) = Axis::new(Track::default()) else {
        return;
    };
    axis.enable();
    let before = axis.inputs.position;
    axis.outputs.mode = 3;
    axis.cycles(10);
    axis.begin("[[fault]]\nkind = 'position-shift'\nvalue = -3000\n");
    axis.cycles(5);
    assert!((axis.inputs.position - before + 3000).abs() <= 1);
}

#[test]
fn the_drive_loses_its_torque_by_sto_and_by_its_enable_input() {
    for (kind, low) in [("sto", 0x40), ("enable-input", 0x21)] {
        let Some(mut axis) = Axis::new(Track::default()) else {
            return;
        };
        axis.enable();
        axis.begin(&format!("[[fault]]\nkind = '{kind}'\nfor = '30ms'\n"));
        axis.cycles(10);
        assert_eq!(axis.inputs.statusword & 0x6f, low, "{kind}");
        assert!(!axis.device().drive().unwrap().power_on());
        for word in [0x06, 0x07, 0x0f] {
            axis.outputs.controlword = word;
            axis.cycles(4);
            assert_eq!(axis.inputs.statusword & 0x6f, low, "{kind}");
        }
        axis.outputs.controlword = 0x06;
        axis.cycles(20);
        axis.enable();
    }
}

/// The motor coasts on after the loss of power, and an absolute encoder counts it.
#[test]
fn an_absolute_encoder_keeps_its_position_without_power() {
    for (key, keeps) in [("absolute_encoder", true), ("halt_ignored", false)] {
        let Some(mut axis) = Axis::with_quirk(key, 1.0) else {
            return;
        };
        axis.enable();
        for _ in 0..200 {
            axis.outputs.target += 20;
            axis.cycle();
        }
        axis.begin("[[fault]]\nkind = 'power-off'\nfor = '3s'\n");
        axis.bus.wait(4_000_000_000);
        let now = axis.bus.now;
        axis.bus.segment.advance(now);
        let drive = axis.device().drive().unwrap();
        let (position, speed) = (drive.position_counts(), drive.velocity_rev_s());
        assert_eq!(position > 4000, keeps, "{key}: {position}");
        assert_eq!(speed, 0.0);
        let shown = axis.device().object(0x6064, 0).unwrap();
        let shown = i32::from_le_bytes(shown.try_into().unwrap());
        assert_eq!(i64::from(shown), position);
    }
}

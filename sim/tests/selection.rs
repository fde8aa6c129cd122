//! The drives of an ESI become simulated drives, in every cyclic mode.

use crate::common::*;
use crate::main_device::bring_up;
use ecaxis_esi::model::{Device, Entry, EsiFile, Module, Slot, Slots};
use ecaxis_esi::{Mode, SelectOptions, offered_modes, select};
use ecaxis_sim::{DeviceOptions, SimDevice};

fn choice(mode: Mode) -> SelectOptions<'static> {
    SelectOptions {
        mode: Some(mode),
        cycle_ns: 1_000_000,
        ..SelectOptions::default()
    }
}

fn has_coe(device: &Device) -> bool {
    let mailbox = device.mailbox.as_ref();
    mailbox.is_some_and(|mailbox| mailbox.coe.is_some())
}

fn esi_files() -> Vec<(String, EsiFile)> {
    let mut folders = vec![fixtures().join("esi")];
    let mut files = Vec::new();
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() {
                folders.push(path);
            } else if path
                .extension()
                .is_some_and(|e| e.eq_ignore_ascii_case("xml"))
                && let Ok(file) = ecaxis_esi::parse(&std::fs::read(&path).unwrap())
            {
                files.push((path.display().to_string(), file));
            }
        }
    }
    files
}

#[test]
fn drives_are_detected_by_channel_profile() {
    for path in [
        "esi/stepperonline/STEPPERONLINE_A6_Servo_V0.02.xml",
        "esi/inovance/SV660_EOE_1Axis_V9.12.xml",
        "esi/hpmicro/ECAT_CIA402.xml",
    ] {
        let Some(bytes) = fixture(path) else { return };
        let file = ecaxis_esi::parse(&bytes).unwrap();
        let device = &file.devices[0];
        let selection = select(&file, device, &choice(Mode::Csp)).unwrap();
        assert_eq!(selection.mode, Some(Mode::Csp), "{path}");
        let sim = SimDevice::from_esi(device, &file.modules, DeviceOptions::default()).unwrap();
        assert!(sim.drive().is_some(), "{path}");
    }
}

#[test]
fn drives_move_in_every_cyclic_mode_they_offer() {
    if fixture("README.md").is_none() {
        return;
    }
    let (mut drives, mut chosen, mut refused) = (0, 0, Vec::new());
    for (path, file) in esi_files() {
        for device in file
            .devices
            .iter()
            .filter(|device| device.profile == Some(402) && has_coe(device))
        {
            drives += 1;
            let sim = SimDevice::from_esi(device, &file.modules, DeviceOptions::default())
                .unwrap_or_else(|error| panic!("{path}: {}: {error}", device.name));
            assert!(sim.drive().is_some(), "{path}: {}", device.name);
            for mode in offered_modes(&file, device) {
                if !mode.is_cyclic() {
                    continue;
                }
                match select(&file, device, &choice(mode)) {
                    Ok(selection) => {
                        chosen += 1;
                        for field in selection.layout.rx.iter().chain(&selection.layout.tx) {
                            assert!(
                                sim.object(field.index, field.sub).is_some(),
                                "{path}: {} {mode}: 0x{:04x}",
                                device.name,
                                field.index
                            );
                        }
                        for note in &selection.notes {
                            eprintln!("{} {mode}: {note}", device.type_name);
                        }
                    }
                    Err(error) => refused.push(format!("{} {mode}: {error}", device.name)),
                }
            }
        }
    }
    eprintln!(
        "{drives} drives, {chosen} selections\n{}",
        refused.join("\n")
    );
    assert!(drives >= 10 && chosen >= 25, "{drives}, {chosen}");
}

/// No profile number and no dictionary entry for it: the PDOs identify the drive. A mapped torque
/// limit acts from the first cycle, also with the value zero.
#[test]
fn drive_detected_by_its_pdos_obeys_a_torque_limit_of_zero() {
    const S: u16 = 0x1001;
    let mut device = coe_device();
    let entries = |entries: &mut Vec<Entry>, list: &[(u16, u16)]| {
        let template = entries[0].clone();
        *entries = list
            .iter()
            .map(|&(index, bit_len)| Entry {
                index,
                sub: 0,
                bit_len,
                ..template.clone()
            })
            .collect();
    };
    entries(
        &mut device.rx_pdos[0].entries,
        &[(0x6040, 16), (0x60ff, 32), (0x6072, 16)],
    );
    entries(
        &mut device.tx_pdos[0].entries,
        &[(0x6041, 16), (0x606c, 32)],
    );
    assert_eq!(device.profile, None);
    assert!(sim(&device).drive().is_some());
    assert!(sim(&coe_device()).drive().is_none());

    let mut bus = Bus::new(vec![sim(&device)]);
    bus.address_all();
    bus.preop(S);
    bus.download(S, 0x6060, 0, &[9]).unwrap();
    bus.sm(S, 2, 0x1100, 8, 0x64);
    bus.sm(S, 3, 0x1200, 6, 0x20);
    bus.to(S, SAFEOP);
    bus.to(S, OP);
    let speed = |bus: &mut Bus, limit: u16| {
        for _ in 0..400 {
            let status = bus.read(S, 0x1200, 6);
            let controlword: u16 = match status[0] & 0x6f {
                0x21 => 0x07,
                0x23 | 0x27 => 0x0f,
                _ => 0x06,
            };
            let mut outputs = controlword.to_le_bytes().to_vec();
            outputs.extend(20_000_i32.to_le_bytes());
            outputs.extend(limit.to_le_bytes());
            bus.write(S, 0x1100, &outputs);
            bus.wait(1_000_000);
        }
        let status = bus.read(S, 0x1200, 6);
        assert_eq!(status[0] & 0x6f, 0x27);
        i32::from_le_bytes(status[2..6].try_into().unwrap())
    };
    assert_eq!(speed(&mut bus, 0), 0);
    assert!((19_000..21_000).contains(&speed(&mut bus, 1000)));
}

/// ETG.1000.6, table 74: a mapping entry states its own length, which may be less than the object's.
#[test]
fn mapping_entry_takes_its_own_length() {
    use ecaxis_esi::model::{Direction, Writable};
    let mut device = coe_device();
    let wide = [0x7010, 0x6010].map(|index| {
        let rw = Writable::Always;
        let parts = (1..=2).map(|sub| item(sub, 16, 16 * u32::from(sub), rw, &[0x55, 0x66]));
        let count = [item(0, 8, 0, Writable::Never, &[2])];
        object(index, count.into_iter().chain(parts).collect())
    });
    device.dictionary.objects.extend(wide);
    device.rx_pdos = vec![pdo(
        Direction::Rx,
        0x1600,
        2,
        &[(0x7010, 1, 8), (0x7010, 2, 16)],
    )];
    device.tx_pdos = vec![pdo(Direction::Tx, 0x1a00, 3, &[(0x6010, 1, 8)])];
    let mut bus = Bus::new(vec![sim(&device)]);
    assert_eq!(bus.address_all(), 1);
    let (_, mapped) = bring_up(&mut bus, 0x1001).unwrap();
    assert_eq!((mapped.outputs, mapped.inputs), (3, 1));
    let exchange = |bus: &mut Bus| {
        let (data, counter) = bus.logical(12, mapped.logical, &[0x11, 0x22, 0x33]);
        bus.wait(1_000_000);
        (data[0], counter)
    };
    exchange(&mut bus);
    // The device copies its outputs to its inputs.
    assert_eq!(exchange(&mut bus), (0x11, 3));
    let value = |sub| {
        bus.segment
            .device(0)
            .unwrap()
            .object(0x7010, sub)
            .unwrap()
            .to_vec()
    };
    assert_eq!((value(1), value(2)), (vec![0x11, 0x66], vec![0x22, 0x33]));
}

/// Returns a device with one oversampled input of 16 bits, at most ten samples a cycle.
fn oversampler(mailbox: &str, increment: u16) -> Device {
    let text = format!(
        "<EtherCATInfo><Vendor><Id>1</Id></Vendor><Descriptions><Devices><Device Physics=\"YY\">\
         <Type ProductCode=\"1\">S</Type><Fmmu>Outputs</Fmmu><Fmmu>Inputs</Fmmu>\
         <Sm StartAddress=\"#x1000\" DefaultSize=\"128\" ControlByte=\"#x26\" Enable=\"1\">MBoxOut</Sm>\
         <Sm StartAddress=\"#x1080\" DefaultSize=\"128\" ControlByte=\"#x22\" Enable=\"1\">MBoxIn</Sm>\
         <Sm StartAddress=\"#x1100\" ControlByte=\"#x64\" Enable=\"1\">Outputs</Sm>\
         <Sm StartAddress=\"#x1400\" ControlByte=\"#x20\" Enable=\"1\">Inputs</Sm>\
         <TxPdo Fixed=\"1\" Sm=\"3\" OSFac=\"1\" OSMax=\"10\" OSIndexInc=\"{increment}\">\
         <Index>#x1a00</Index><Entry><Index>#x6000</Index><SubIndex>1</SubIndex>\
         <BitLen>16</BitLen></Entry></TxPdo>{mailbox}\
         <Dc><OpMode><Name>X4</Name><AssignActivate>#x730</AssignActivate>\
         <Sm No=\"3\"><Pdo OSFac=\"4\">#x1a00</Pdo></Sm></OpMode></Dc>\
         </Device></Devices></Descriptions></EtherCATInfo>"
    );
    ecaxis_esi::parse(text.as_bytes())
        .unwrap()
        .devices
        .remove(0)
}

/// ETG.2000: `OSFac` of an OpMode. The samples of a cycle are further PDOs or a longer one. Without
/// an object for it, the device takes their number from the length of the SyncManager.
#[test]
fn oversampled_inputs_have_one_sample_or_those_of_an_op_mode() {
    const S: u16 = 0x1001;
    let assignable = "<Mailbox><CoE PdoAssign=\"1\"/></Mailbox>";
    for (mailbox, increment, samples) in [
        (assignable, 16, &[0x1a00_u16, 0x1a01, 0x1a02, 0x1a03][..]),
        (assignable, 0, &[0x1a00]),
        ("", 16, &[]),
        ("", 0, &[]),
    ] {
        let mut bus = Bus::new(vec![sim(&oversampler(mailbox, increment))]);
        bus.mailboxes = [(0x1000, 128), (0x1080, 128)];
        bus.address_all();
        for (len, accepted) in [(2, true), (4, false), (8, true), (2, true)] {
            // Acknowledges the refusal before.
            bus.request(S, u16::from(INIT) | 0x10);
            for n in [0, 1, 3] {
                bus.write(S, 0x806 + n * 8, &[0]);
            }
            if mailbox.is_empty() {
                bus.to(S, PREOP);
            } else {
                bus.preop(S);
                let assigned = if len == 8 { samples } else { &[0x1a00] };
                bus.download(S, 0x1c13, 0, &[0]).unwrap();
                for (sub, pdo) in (1..).zip(assigned) {
                    bus.download(S, 0x1c13, sub, &pdo.to_le_bytes()).unwrap();
                }
                bus.download(S, 0x1c13, 0, &[assigned.len() as u8]).unwrap();
            }
            bus.sm(S, 3, 0x1400, len, 0x20);
            bus.request(S, SAFEOP.into());
            let state = bus.segment.device(0).unwrap().al_state();
            let reached = state == ecaxis_sim::AlState::SafeOp;
            assert_eq!(reached, accepted, "{mailbox} {increment}: {len} bytes");
        }
    }
}

/// ETG.2000: `OSFac` of a PDO is the number of samples unless an OpMode says otherwise. The objects have
/// them at power-on, as further PDOs or a longer entry; the EEPROM (ETG.2010) has one.
#[test]
fn oversampled_pdo_has_its_own_samples_at_power_on() {
    const S: u16 = 0x1001;
    let assignable = "<Mailbox><CoE PdoAssign=\"1\"/></Mailbox>";
    for (increment, assigned, bits) in [(16, &[0x1a00_u16, 0x1a01][..], 16), (0, &[0x1a00], 32)] {
        let mut device = oversampler(assignable, increment);
        device.tx_pdos[0].oversampling.as_mut().unwrap().factor = 2;
        let mut bus = Bus::new(vec![sim(&device)]);
        bus.mailboxes = [(0x1000, 128), (0x1080, 128)];
        bus.address_all();
        bus.preop(S);
        let count = bus.upload(S, 0x1c13, 0).unwrap()[0];
        let listed: Vec<u16> = (1..=count)
            .map(|sub| {
                let pdo = bus.upload(S, 0x1c13, sub).unwrap();
                u16::from_le_bytes(pdo.try_into().unwrap())
            })
            .collect();
        assert_eq!(listed, assigned, "increment {increment}");
        for (n, pdo) in (0..).zip(assigned) {
            let [low, high] = (0x6000 + n * increment).to_le_bytes();
            assert_eq!(bus.upload(S, *pdo, 1).unwrap(), [bits, 1, low, high]);
        }
        let sii = ecaxis_esi::sii::parse(bus.segment.device(0).unwrap().sii()).unwrap();
        let described: Vec<_> = sii.tx_pdos.iter().map(|p| (p.index, p.bit_len())).collect();
        assert_eq!(described, [(0x1a00, 16)]);
        bus.sm(S, 3, 0x1400, 4, 0x20);
        bus.to(S, SAFEOP);
    }
}

/// A MainDevice that maps one sample left it to the next one, which expects those of the ESI.
#[test]
fn samples_by_the_length_of_a_sync_manager_end_with_safe_op() {
    const S: u16 = 0x1001;
    let assignable = "<Mailbox><CoE PdoAssign=\"1\"/></Mailbox>";
    let mut device = oversampler(assignable, 0);
    device.tx_pdos[0].oversampling.as_mut().unwrap().factor = 2;
    let mut bus = Bus::new(vec![sim(&device)]);
    bus.mailboxes = [(0x1000, 128), (0x1080, 128)];
    bus.address_all();
    for len in [8, 4, 8] {
        bus.preop(S);
        assert_eq!(bus.upload(S, 0x1a00, 1).unwrap(), [32, 1, 0x00, 0x60]);
        bus.sm(S, 3, 0x1400, len, 0x20);
        bus.to(S, SAFEOP);
        let bits = u8::try_from(8 * len).unwrap();
        assert_eq!(bus.upload(S, 0x1a00, 1).unwrap(), [bits, 1, 0x00, 0x60]);
        bus.to(S, INIT);
        for n in [0, 1, 3] {
            bus.write(S, 0x806 + n * 8, &[0]);
        }
    }
}

/// A module with an oversampled PDO was plugged with one sample, and its SyncManager had the length of
/// all samples.
#[test]
fn oversampled_pdo_of_a_module_has_its_samples_at_power_on() {
    const S: u16 = 0x1001;
    for (increment, indices, bits) in [(16, &[0x1a00_u16, 0x1a01][..], 16), (0, &[0x1a00], 32)] {
        let mut device = oversampler("<Mailbox><CoE PdoAssign=\"1\"/></Mailbox>", increment);
        device.dc_modes.clear();
        let mut pdo = device.tx_pdos.remove(0);
        pdo.oversampling.as_mut().unwrap().factor = 2;
        let slot = Slot {
            max_instances: 1,
            module_idents: vec![(1, true)],
            ..Slot::default()
        };
        device.slots = Some(Slots {
            slots: vec![slot],
            ..Slots::default()
        });
        let module = Module {
            ident: 1,
            tx_pdos: vec![pdo],
            ..Module::default()
        };
        let sim = SimDevice::from_esi(&device, &[module], DeviceOptions::default()).unwrap();
        let mut bus = Bus::new(vec![sim]);
        bus.mailboxes = [(0x1000, 128), (0x1080, 128)];
        bus.address_all();
        bus.preop(S);
        for (n, pdo) in (0..).zip(indices) {
            let [low, high] = (0x6000 + n * increment).to_le_bytes();
            assert_eq!(bus.upload(S, *pdo, 1).unwrap(), [bits, 1, low, high]);
        }
        bus.sm(S, 3, 0x1400, 4, 0x20);
        bus.to(S, SAFEOP);
    }
}

/// The object of an oversampled PDO has all samples of a cycle; a mapping entry may have fewer.
#[test]
fn oversampled_pdo_is_mapped_with_any_number_of_samples() {
    const S: u16 = 0x1001;
    let mut device = oversampler(
        "<Mailbox><CoE PdoAssign=\"1\" PdoConfig=\"1\"/></Mailbox>",
        0,
    );
    device.tx_pdos[0].fixed = false;
    let mut bus = Bus::new(vec![sim(&device)]);
    bus.mailboxes = [(0x1000, 128), (0x1080, 128)];
    bus.address_all();
    bus.preop(S);
    bus.download(S, 0x1c13, 0, &[0]).unwrap();
    for (bits, accepted) in [(16, true), (64, true), (80, false)] {
        bus.download(S, 0x1a00, 0, &[0]).unwrap();
        let entry = [bits, 1, 0x00, 0x60];
        let done = bus.download(S, 0x1a00, 1, &entry);
        assert_eq!(done.is_ok(), accepted, "{bits} bits");
    }
}

//! What a SyncManager carries, by its PDOs, its text and its ControlByte.

use ecaxis_esi::sii::{self, SiiOptions};
use ecaxis_esi::{Device, Direction, SelectOptions, SmUse, parse, select};

const MAILBOXES: &str = "\
    <Sm StartAddress=\"#x1000\" DefaultSize=\"128\" ControlByte=\"#x26\" Enable=\"1\"/>\
    <Sm StartAddress=\"#x1080\" DefaultSize=\"128\" ControlByte=\"#x22\" Enable=\"1\"/>";

fn pdo(direction: Direction, sm: u8) -> String {
    let (kind, index, object) = match direction {
        Direction::Rx => ("RxPdo", "#x1600", "#x7000"),
        Direction::Tx => ("TxPdo", "#x1a00", "#x6000"),
    };
    format!(
        "<{kind} Fixed=\"1\" Sm=\"{sm}\"><Index>{index}</Index><Entry><Index>{object}</Index>\
         <SubIndex>1</SubIndex><BitLen>8</BitLen></Entry></{kind}>"
    )
}

fn document(inside: &str) -> String {
    format!(
        "<EtherCATInfo><Vendor><Id>1</Id></Vendor><Descriptions><Devices><Device Physics=\"YY\">\
         <Type ProductCode=\"1\">T</Type>{inside}</Device></Devices></Descriptions></EtherCATInfo>"
    )
}

/// Reads a device with one SyncManager. Returns its usage and the number of warnings.
fn usage(text: &str, control: u8, enable: u8, pdos: &[Direction]) -> (SmUse, usize) {
    let pdos: String = pdos.iter().map(|direction| pdo(*direction, 0)).collect();
    let sm = format!(
        "<Sm StartAddress=\"#x1000\" ControlByte=\"{control}\" Enable=\"{enable}\">{text}</Sm>"
    );
    let file = parse(document(&format!("{sm}{pdos}")).as_bytes()).unwrap();
    (file.devices[0].sync_managers[0].usage, file.warnings.len())
}

#[test]
fn pdos_text_and_control_byte_decide_the_usage() {
    use Direction::{Rx, Tx};
    use SmUse::{Inputs, MBoxIn, MBoxOut, Other, Outputs};
    for (text, control, enable, pdos, expected, warnings) in [
        // The PDOs alone, also without ControlByte or against it.
        ("", 0x64, 0, &[Rx][..], Outputs, 0),
        ("", 0x00, 0, &[Rx], Outputs, 0),
        ("MyInputs", 0x20, 1, &[Tx, Tx], Inputs, 0),
        // One buffer.
        ("", 0x26, 1, &[Rx], Outputs, 0),
        // Against the text, unless the ControlByte agrees with the text.
        ("Outputs", 0x00, 1, &[Tx], Inputs, 1),
        ("Outputs", 0x64, 1, &[Tx], Outputs, 0),
        // PDOs of both directions decide nothing.
        ("Outputs", 0x00, 1, &[Rx, Tx], Outputs, 0),
        ("", 0x20, 1, &[Rx, Tx], Inputs, 0),
        // Without PDOs: the text, otherwise the ControlByte of an enabled SyncManager.
        ("Inputs", 0x64, 1, &[], Inputs, 0),
        ("", 0x64, 1, &[], Outputs, 0),
        ("", 0x26, 1, &[], MBoxOut, 0),
        ("Own", 0x22, 1, &[], MBoxIn, 0),
        ("", 0x64, 0, &[], Other, 0),
        ("", 0x23, 1, &[], Other, 0),
        // A mailbox remains one.
        ("MBoxOut", 0x26, 1, &[Tx], MBoxOut, 0),
    ] {
        let found = usage(text, control, enable, pdos);
        assert_eq!(
            found,
            (expected, warnings),
            "{text:?} 0x{control:02x} enabled {enable}, {pdos:?}"
        );
    }
}

/// As `ethercat xml` writes them.
#[test]
fn sync_managers_without_text_carry_the_process_data() {
    let sms = "<Sm StartAddress=\"#x1100\" ControlByte=\"#x64\" Enable=\"1\"/>\
        <Sm StartAddress=\"#x1400\" ControlByte=\"#x20\" Enable=\"1\"/>";
    let inside = [
        MAILBOXES,
        sms,
        &pdo(Direction::Rx, 2),
        &pdo(Direction::Tx, 3),
    ]
    .concat();
    let file = parse(document(&inside).as_bytes()).unwrap();
    let device = &file.devices[0];
    let usages = |device: &Device| -> Vec<SmUse> {
        let all = device.sync_managers.iter();
        all.map(|sm| sm.usage).collect()
    };
    let all = [SmUse::MBoxOut, SmUse::MBoxIn, SmUse::Outputs, SmUse::Inputs];
    assert_eq!(usages(device), all);
    let selection = select(&file, device, &SelectOptions::default()).unwrap();
    let layout = &selection.layout;
    assert_eq!((layout.outputs[0].sm, layout.inputs[0].sm), (2, 3));

    // The EEPROM image of the ESI says it too, and so does an image without types.
    let image = sii::emit(device, &[], &SiiOptions::default());
    let mut sii = sii::parse(&image).unwrap();
    let stated: Vec<SmUse> = sii.sync_managers.iter().map(|sm| sm.usage).collect();
    assert_eq!(stated, all);
    for sm in &mut sii.sync_managers {
        (sm.usage, sm.enable) = (SmUse::Other, 1);
    }
    assert_eq!(usages(&sii.to_device()), all);
}

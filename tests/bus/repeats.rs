//! Objects that several output PDOs of a device map.

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_master::config::Machine;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::recordings::process_images;
use ecaxis_test_support::{recorded, run_well, virtual_time};

/// Returns a drive with two mandatory, fixed output PDOs, both with the Controlword. Its assignment
/// cannot be changed.
fn drive(bench: &Bench) -> Machine {
    bench.change("esi/SV1.xml", |esi| {
        let sub = |number: u8, name: &str, kind: &str, bits: u8, offset: u8| {
            format!(
                "<SubItem><SubIdx>{number}</SubIdx><Name>{name}</Name><Type>{kind}</Type><BitSize>{bits}</BitSize>\
                 <BitOffs>{offset}</BitOffs><Flags><Access>ro</Access></Flags></SubItem>"
            )
        };
        let kind = |name: &str, bits: u8, subs: String| {
            format!("<DataType><Name>{name}</Name><BitSize>{bits}</BitSize>{subs}</DataType>")
        };
        let count = sub(0, "Number", "USINT", 8, 0);
        let types = [
            kind("DT1601", 48, count.clone() + &sub(1, "Object 1", "UDINT", 32, 16)),
            kind(
                "DT1C12B",
                48,
                count + &sub(1, "PDO 1", "UINT", 16, 16) + &sub(2, "PDO 2", "UINT", 16, 32),
            ),
        ];
        let value = |name: &str, value: &str| {
            format!("<SubItem><Name>{name}</Name><Info><DefaultValue>{value}</DefaultValue></Info></SubItem>")
        };
        let mapping = format!(
            "<Object><Index>#x1601</Index><Name>RxPDO 2 mapping</Name><Type>DT1601</Type><BitSize>48</BitSize>\
             <Info>{}{}</Info><Flags><Access>ro</Access></Flags></Object>",
            value("Number", "1"),
            value("Object 1", "#x60400010"),
        );
        let pdo = "<RxPdo Fixed=\"1\" Mandatory=\"1\" Sm=\"2\"><Index>#x1601</Index><Name>Controlword once more</Name>\
             <Entry><Index>#x6040</Index><SubIndex>0</SubIndex><BitLen>16</BitLen><Name>Controlword</Name>\
             <DataType>UINT</DataType></Entry></RxPdo>";
        let assigned = "<SubItem><Name>PDO</Name><Info><DefaultValue>#x1600</DefaultValue></Info></SubItem>";
        let number = "<SubItem><Name>Number</Name><Info><DefaultValue>1</DefaultValue></Info></SubItem>";
        let (before, after) = esi.split_once("<Index>#x1C12</Index>").expect("0x1C12");
        let after = after
            .replacen("<Type>DT1C12</Type><BitSize>32</BitSize>", "<Type>DT1C12B</Type><BitSize>48</BitSize>", 1)
            .replacen(number, &value("Number", "2"), 1)
            .replacen(assigned, &format!("{assigned}{}", value("PDO 2", "#x1601")), 1)
            .replacen("</RxPdo>", &format!("</RxPdo>{pdo}"), 1);
        let before = before
            .replacen("</DataTypes>", &format!("{}</DataTypes>", types.concat()), 1)
            .replacen("<Objects>", &format!("<Objects>{mapping}"), 1);
        format!("{before}<Index>#x1C12</Index>{after}")
    });
    let text = "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n\
        [[device]]\nname = \"z\"\nesi = \"esi/SV1.xml\"\nposition = 0\nmode = \"csp\"\n\
        [device.axis]\nunit = \"turn\"\nencoder = 131072\n\
        limits = { velocity = 20.0, acceleration = 100.0, torque = 100.0, following_error = 1.0 }\n\
        [[step]]\nmove = { z = 3.0 }\n";
    bench.machine(text)
}

/// The simulated drive takes the last of the Controlwords, as real ones do.
#[test]
fn an_axis_with_two_controlwords_enables_and_moves() {
    let bench = Bench::new();
    let machine = drive(&bench);
    let selection = &machine.devices[DeviceIndex(0)].selection;
    let layout = &selection.layout;
    let places: Vec<u32> = layout
        .rx
        .iter()
        .filter(|field| field.index == 0x6040)
        .map(|field| field.bit_offset)
        .collect();
    assert_eq!((places, layout.rx_bytes()), (vec![0, 96], 14));
    let note = "0x6040:00 is mapped in PDO 0x1600 and again in 0x1601";
    let noted = selection.notes.iter().any(|text| text.contains(note));
    assert!(noted, "{:?}", selection.notes);

    let (options, recording) = recorded(virtual_time(), bench.path());
    let summary = run_well(machine, options);
    let axis = &summary.axes[0];
    assert_eq!(axis.target_position, 3.0);
    assert!((axis.final_position - 3.0).abs() < 0.001, "{axis:?}");
    let images = process_images(&recording);
    let mut powered = 0;
    for (sent, _) in images.iter().filter(|(sent, _)| sent.len() >= 14) {
        assert_eq!(sent[..2], sent[12..14], "both Controlwords in every frame");
        powered += usize::from(sent[0] == 0x0f);
    }
    assert!(powered > 200, "{powered}");
}

//! Modules in slots.

use super::*;

/// A block with an input and an output module, each the default of a slot, and without assignment
/// objects in its dictionary. `required`: the modules that the second slot needs.
fn block(required: u32) -> EsiFile {
    let module = |ident: u32, kind: &str, sm: u8, pdo: &str, object: &str| {
        format!(
            "<Module><Type ModuleIdent=\"{ident}\">M{ident}</Type><Name>Module {ident}</Name>\
             <{kind} Fixed=\"1\" Sm=\"{sm}\"><Index DependOnSlot=\"1\">{pdo}</Index><Name>P</Name>\
             <Entry><Index DependOnSlot=\"1\">{object}</Index><SubIndex>1</SubIndex>\
             <BitLen>8</BitLen><Name>Byte</Name><DataType>USINT</DataType></Entry></{kind}></Module>"
        )
    };
    let slot = |default: u32, min: u32| {
        let ident = |n: u32| {
            let default = if n == default { " Default=\"1\"" } else { "" };
            format!("<ModuleIdent{default}>{n}</ModuleIdent>")
        };
        format!(
            "<Slot MinInstances=\"{min}\" MaxInstances=\"1\"><Name>Slot {default}</Name>{}{}</Slot>",
            ident(1),
            ident(2)
        )
    };
    let text = format!(
        "<EtherCATInfo><Vendor><Id>1</Id></Vendor><Descriptions><Devices><Device>\
         <Type ProductCode=\"1\" RevisionNo=\"1\">BLOCK</Type><Name>Block</Name>\
         <Profile><Dictionary><DataTypes><DataType><Name>UDINT</Name><BitSize>32</BitSize></DataType>\
         </DataTypes><Objects><Object><Index>#x1000</Index><Name>Device type</Name><Type>UDINT</Type>\
         <BitSize>32</BitSize></Object></Objects></Dictionary></Profile>\
         <Fmmu>Outputs</Fmmu><Fmmu>Inputs</Fmmu>\
         <Sm DefaultSize=\"128\" StartAddress=\"#x1000\" ControlByte=\"#x26\" Enable=\"1\">MBoxOut</Sm>\
         <Sm DefaultSize=\"128\" StartAddress=\"#x1100\" ControlByte=\"#x22\" Enable=\"1\">MBoxIn</Sm>\
         <Sm StartAddress=\"#x1200\" ControlByte=\"#x64\">Outputs</Sm>\
         <Sm StartAddress=\"#x1300\" ControlByte=\"#x20\">Inputs</Sm>\
         <Mailbox><CoE PdoAssign=\"1\"/></Mailbox>\
         <Slots MaxSlotCount=\"2\" SlotPdoIncrement=\"1\" SlotIndexIncrement=\"16\" \
         DownloadModuleIdentList=\"1\">{}{}</Slots></Device></Devices><Modules>{}{}</Modules>\
         </Descriptions></EtherCATInfo>",
        slot(1, 0),
        slot(2, required),
        module(1, "TxPdo", 3, "#x1A00", "#x6000"),
        module(2, "RxPdo", 2, "#x1600", "#x7000"),
    );
    parse(text.as_bytes()).expect("an ESI file")
}

fn with_modules(file: &EsiFile, modules: Option<&[&str]>) -> Selection {
    let choice = SelectOptions {
        modules,
        cycle_ns: MS,
        ..SelectOptions::default()
    };
    choose(file, &choice).expect("a choice that fits")
}

fn places(selection: &Selection) -> Vec<(usize, u32)> {
    let modules = selection.modules.iter();
    modules.map(|m| (m.place, m.ident)).collect()
}

/// A short list once left the other slots with their defaults, so `[]` and `["-", "-"]` differed.
#[test]
fn a_list_of_modules_is_complete() {
    let file = block(0);
    let places = |modules: Option<&[&str]>| places(&with_modules(&file, modules));
    assert_eq!(places(None), [(0, 1), (1, 2)], "the defaults");
    for none in [&[][..], &["-"], &["", ""], &["-", "-"]] {
        assert_eq!(places(Some(none)), [], "{none:?}");
    }
    assert_eq!(places(Some(&["M1"])), [(0, 1)]);
    assert_eq!(places(Some(&["-", "M1"])), [(1, 1)]);
    let required = block(1);
    let selection = with_modules(&required, Some(&[]));
    assert_eq!(self::places(&selection), [(1, 2)], "a required slot");
    // What a device reports is written as it is read.
    for idents in [&[][..], &[0, 0], &[1, 0], &[0, 2], &[2, 1]] {
        let names = ecaxis_esi::module_names(&file.modules, idents);
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let wanted = idents.iter().copied().enumerate();
        let wanted: Vec<_> = wanted.filter(|(_, ident)| *ident != 0).collect();
        assert_eq!(places(Some(&names)), wanted, "{names:?}");
    }
}

/// A name that several modules have selects none of them, so a list has their identities.
#[test]
fn modules_with_one_name_are_listed_by_identity() {
    let mut file = block(0);
    let name = file.modules[0].type_name.clone();
    file.modules[1].type_name = name;
    let names = ecaxis_esi::module_names(&file.modules, &[1, 2]);
    assert_eq!(names, ["0x00000001", "0x00000002"]);
}

/// ETG.1000.6: assignment and module list keep what an earlier configuration wrote. The device then
/// refused SafeOp with 0x001E, because its inputs had a length that the SyncManager had not.
#[test]
fn lists_without_elements_are_cleared() {
    let file = block(0);
    let start = |modules: &[&str]| with_modules(&file, Some(modules)).startup;
    let cleared = |startup: &[StartupSdo]| -> Vec<u16> {
        let cleared = startup.iter().filter(|sdo| sdo.clears_list());
        cleared.map(|sdo| sdo.index).collect()
    };
    let both = start(&["M1", "M2"]);
    assert_eq!(cleared(&both), []);
    let outputs = start(&["-", "M2"]);
    assert_eq!(cleared(&outputs), [0x1c13]);
    assert_eq!(
        written(&outputs)[..4],
        [
            (0xf030, 0, 0),
            (0xf030, 1, 0),
            (0xf030, 2, 2),
            (0xf030, 0, 2)
        ]
    );
    assert_eq!(cleared(&start(&["M1", "-"])), [0x1c12]);
    assert_eq!(
        written(&start(&[])),
        [(0xf030, 0, 0), (0x1c12, 0, 0), (0x1c13, 0, 0)]
    );
    assert_eq!(cleared(&start(&[])), [0xf030, 0x1c12, 0x1c13]);
}

/// Two axes in one device: the slot's increments shift the indices of the second module.
#[test]
fn a_module_in_the_second_slot_has_shifted_indices() {
    let Some(file) = file("esi/hpmicro/ECAT_CIA402.xml") else {
        return;
    };
    let choice = SelectOptions {
        modules: Some(&["0x319800", "0x219800"]),
        cycle_ns: MS,
        ..SelectOptions::default()
    };
    let selection = choose(&file, &choice).unwrap();
    let places: Vec<_> = selection
        .modules
        .iter()
        .map(|m| (m.place, m.slot_name.as_str()))
        .collect();
    assert_eq!(places, [(0, "Axis 0"), (1, "Axis 1")]);
    let indices: Vec<u16> = selection.rx.iter().map(|pdo| pdo.index).collect();
    assert_eq!(indices, [0x1602, 0x1601 + 16]);
    let controlwords =
        [0x6040, 0x6840].map(|index| selection.layout.rx_field(index, 0).unwrap().bit_offset);
    assert_eq!(controlwords, [0, 64]);
    assert!(
        selection.dictionary.object(0x683f).is_some(),
        "0x603F + 0x800"
    );
    let modes: Vec<_> = selection
        .startup
        .iter()
        .filter(|sdo| sdo.transition == "SO")
        .map(|sdo| (sdo.index, sdo.data[0]))
        .collect();
    assert_eq!(modes, [(0x6060, 9), (0x6860, 8)]);
}

/// ETG.2000: a slot with `MinInstances="0"` may stay empty. The second slot of this vendor's device
/// is one; its objects are 0x800 later, so it holds the second axis (CiA 402-1).
#[test]
fn an_optional_slot_is_filled_if_its_axis_is_used() {
    let Some(file) = file("esi/hpmicro/ECAT_CIA402.xml") else {
        return;
    };
    let device = &file.devices[0];
    let slots = device.slots.as_ref().expect("slots");
    assert_eq!(slots.slots[1].min_instances, 0);
    let choose = |axes: &[u16], modules: Option<&[&str]>| {
        let choice = SelectOptions {
            mode: Some(Mode::Csp),
            axes,
            modules,
            cycle_ns: MS,
            ..SelectOptions::default()
        };
        choose(&file, &choice)
    };
    let places = |axes: &[u16]| -> Vec<(usize, u32)> {
        let selection = choose(axes, None).unwrap();
        let modules = selection.modules.iter();
        modules.map(|m| (m.place, m.ident)).collect()
    };
    assert_eq!(places(&[0]).len(), 1);
    let two = places(&[0, 1]);
    assert_eq!(two.len(), 2, "{two:?}");
    assert_eq!((two[0].1, two[1].0), (two[1].1, 1));
    // Only the second axis: the first slot needs a module all the same.
    assert_eq!(places(&[1]), two);
    // The user's own choice wins.
    assert!(choose(&[0, 1], Some(&["0x319800", "-"])).is_err());
}

#[test]
fn a_module_that_does_not_fit_is_rejected_by_name() {
    let Some(file) = file("esi/hpmicro/ECAT_CIA402.xml") else {
        return;
    };
    let refused = |modules: &[&str]| {
        let choice = SelectOptions {
            modules: Some(modules),
            cycle_ns: MS,
            ..SelectOptions::default()
        };
        choose(&file, &choice).unwrap_err().to_string()
    };
    let text = refused(&["-", "-"]);
    assert!(text.contains("slot \"Axis 0\" needs a module"), "{text}");
    let text = refused(&["0x319800", "valve"]);
    assert!(
        text.contains("takes no module \"valve\"; the ESI offers"),
        "{text}"
    );
    let text = refused(&["0x319800", "-", "-"]);
    assert!(
        text.contains("3 modules are listed, there are 2 places"),
        "{text}"
    );
}

/// Returns a coupler with one module of two inputs, of which the second has these attributes.
fn coupler(first: &str, second: &str, coe: &str) -> EsiFile {
    let pdo = |attributes: &str, index: &str, bits: u8| {
        format!(
            "<TxPdo Fixed=\"1\" {attributes}><Index DependOnSlot=\"1\">{index}</Index>\
             <Entry><Index DependOnSlot=\"1\">#x6000</Index><SubIndex>{bits}</SubIndex>\
             <BitLen>{bits}</BitLen></Entry></TxPdo>"
        )
    };
    let text = format!(
        "<EtherCATInfo><Vendor><Id>1</Id></Vendor><Descriptions><Devices><Device>\
         <Type ProductCode=\"1\">C</Type>\
         <Sm StartAddress=\"#x1000\" DefaultSize=\"128\" ControlByte=\"#x26\">MBoxOut</Sm>\
         <Sm StartAddress=\"#x1080\" DefaultSize=\"128\" ControlByte=\"#x22\">MBoxIn</Sm>\
         <Sm StartAddress=\"#x1100\" ControlByte=\"#x64\">Outputs</Sm>\
         <Sm StartAddress=\"#x1800\" ControlByte=\"#x20\">Inputs</Sm>\
         <Mailbox><CoE {coe}/></Mailbox>\
         <Slots SlotPdoIncrement=\"8\" SlotIndexIncrement=\"#x40\">\
         <Slot MinInstances=\"0\" MaxInstances=\"2\"><ModuleIdent>#x10</ModuleIdent></Slot></Slots>\
         </Device></Devices><Modules><Module><Type ModuleIdent=\"#x10\">M</Type>{}{}</Module>\
         </Modules></Descriptions></EtherCATInfo>",
        pdo(first, "#x1a00", 8),
        pdo(second, "#x1a04", 16),
    );
    parse(text.as_bytes()).unwrap_or_else(|error| panic!("{error}"))
}

/// ETG.2000: a PDO without `Sm` is not assigned by default, unless it is mandatory. It remains
/// assignable. Only a module that names no SyncManager at all gets the one of the direction.
#[test]
fn module_pdos_without_a_sync_manager_are_not_assigned_by_default() {
    for coe in ["PdoAssign=\"1\"", ""] {
        for (first, second, expected, bytes) in [
            ("Sm=\"3\"", "", &[0x1a08][..], 1),
            ("Sm=\"3\"", "Mandatory=\"1\"", &[0x1a08, 0x1a0c], 3),
            ("Sm=\"3\"", "Sm=\"3\"", &[0x1a08, 0x1a0c], 3),
            ("", "", &[0x1a08, 0x1a0c], 3),
        ] {
            let file = coupler(first, second, coe);
            let choice = SelectOptions {
                modules: Some(&["-", "M"]),
                ..SelectOptions::default()
            };
            let selection = choose(&file, &choice).unwrap();
            let tx: Vec<_> = selection.tx.iter().map(|pdo| (pdo.index, pdo.sm)).collect();
            let expected: Vec<_> = expected.iter().map(|index| (*index, Some(3))).collect();
            assert_eq!(tx, expected, "{first} {second} {coe}");
            assert_eq!(selection.layout.tx_bytes(), bytes, "{first} {second} {coe}");
        }
    }
    let file = coupler("Sm=\"3\"", "", "PdoAssign=\"1\"");
    let wanted = [EntryRef {
        index: 0x6000,
        sub: 16,
    }];
    let choice = SelectOptions {
        modules: Some(&["M"]),
        tx: Some(&wanted),
        ..SelectOptions::default()
    };
    let selection = choose(&file, &choice).unwrap();
    assert_eq!(selection.tx[0].index, 0x1a04);
}

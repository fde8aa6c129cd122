//! Special cases from vendor files, reproduced with small files: oversampling, mappings that exist
//! only in the dictionary, commands that follow the configuration, PDOs without entries.

use ecaxis_esi::{
    EsiFile, SelectError, SelectOptions, Selection, Severity, StartupSdo, lint, parse, select,
};

fn device(mailbox: &str, inside: &str) -> EsiFile {
    let text = format!(
        "<EtherCATInfo><Vendor><Id>1</Id></Vendor><Descriptions><Devices><Device>\n\
         <Type ProductCode=\"1\">T</Type>\n\
         <Sm StartAddress=\"#x1000\" DefaultSize=\"128\">MBoxOut</Sm><Sm StartAddress=\"#x1080\" DefaultSize=\"128\">MBoxIn</Sm>\n\
         <Sm StartAddress=\"#x1100\" ControlByte=\"#x64\">Outputs</Sm><Sm StartAddress=\"#x1800\" ControlByte=\"#x20\">Inputs</Sm>\n\
         <Sm StartAddress=\"#x2800\" ControlByte=\"#x20\">Inputs</Sm>\n\
         {mailbox}\n{inside}</Device></Devices></Descriptions></EtherCATInfo>"
    );
    parse(text.as_bytes()).unwrap_or_else(|error| panic!("{error}"))
}

fn choose(file: &EsiFile, dc_mode: Option<&str>) -> Result<Selection, SelectError> {
    let choice = SelectOptions {
        dc_mode,
        cycle_ns: 1_000_000,
        ..SelectOptions::default()
    };
    select(file, &file.devices[0], &choice)
}

fn written(startup: &[StartupSdo]) -> Vec<(u16, u8, &[u8])> {
    startup
        .iter()
        .map(|sdo| (sdo.index, sdo.sub, sdo.data.as_slice()))
        .collect()
}

fn inputs(selection: &Selection) -> Vec<(u16, u16, u32, u16)> {
    let fields = selection.layout.tx.iter();
    fields
        .map(|field| (field.pdo, field.index, field.bit_offset, field.bit_len))
        .collect()
}

const SAMPLED: &str = "\
    <TxPdo Fixed=\"1\" Sm=\"3\"><Index>#x1b00</Index><Entry><Index>#x6800</Index><BitLen>16</BitLen></Entry></TxPdo>\
    <TxPdo Fixed=\"1\" Sm=\"3\" OSFac=\"10\" OSMax=\"100\" OSIndexInc=\"8\"><Index>#x1a00</Index>\
    <Entry><Index>#x6000</Index><SubIndex>1</SubIndex><BitLen>1</BitLen></Entry></TxPdo>\
    <TxPdo Fixed=\"1\" Sm=\"4\"><Index>#x1b01</Index><Entry><Index>#x6801</Index><BitLen>16</BitLen></Entry></TxPdo>";

fn op_mode(name: &str, pdos: &str) -> String {
    format!(
        "<Dc><OpMode><Name>{name}</Name><AssignActivate>#x730</AssignActivate><Sm No=\"3\">{pdos}</Sm></OpMode></Dc>"
    )
}

/// Three samples: three PDOs with an index step of eight.
#[test]
fn samples_with_an_index_increment_are_separate_pdos() {
    let dc = op_mode("DC", "<Pdo>#x1B00</Pdo><Pdo OSFac=\"3\">#x1A00</Pdo>");
    let file = device("", &format!("{SAMPLED}{dc}"));
    let selection = choose(&file, None).unwrap();
    assert_eq!(
        inputs(&selection),
        [
            (0x1b00, 0x6800, 0, 16),
            (0x1a00, 0x6000, 16, 1),
            (0x1a01, 0x6008, 17, 1),
            (0x1a02, 0x6010, 18, 1),
        ]
    );
    assert_eq!(selection.layout.tx_bytes(), 3);
}

/// The OpMode defines the number of samples. Without it, the PDO's own factor applies.
#[test]
fn oversampling_without_an_op_mode_uses_the_factor_of_the_pdo() {
    let file = device("", SAMPLED);
    let selection = choose(&file, None).unwrap();
    assert_eq!(selection.tx.len(), 1 + 10 + 1);
    assert_eq!(selection.layout.inputs[0].len, (16u16 + 10).div_ceil(8));
}

/// An OpMode disables channels that it does not list; they lose their default assignment.
#[test]
fn an_op_mode_disables_channels_that_it_does_not_list() {
    let dc = op_mode("One", "<Pdo>#x1B00</Pdo>");
    let selection = choose(&device("", &format!("{SAMPLED}{dc}")), None).unwrap();
    let sms: Vec<u8> = selection.layout.inputs.iter().map(|sm| sm.sm).collect();
    assert_eq!(sms, [3]);
    // The OpMode does not affect the other direction.
    let out = "<RxPdo Sm=\"2\"><Index>#x1600</Index><Entry><Index>#x7000</Index><BitLen>8</BitLen></Entry></RxPdo>";
    let file = device("", &format!("{SAMPLED}{out}{dc}"));
    assert_eq!(choose(&file, None).unwrap().layout.rx_bytes(), 1);
}

/// An FMMU with a SyncManager in the file belongs to that SyncManager, independent of the others.
#[test]
fn an_fmmu_belongs_to_the_sync_manager_that_it_names() {
    let fmmus = "<Fmmu>Outputs</Fmmu><Fmmu Sm=\"3\">Inputs</Fmmu><Fmmu Sm=\"4\">Inputs</Fmmu>";
    let dc = "<Dc><OpMode><Name>Second</Name><Sm No=\"4\"><Pdo>#x1b01</Pdo></Sm></OpMode></Dc>";
    let fmmu = |fmmus: &str, dc: &str| {
        let file = device("", &format!("{fmmus}{SAMPLED}{dc}"));
        let inputs = choose(&file, None).unwrap().layout.inputs;
        inputs.iter().map(|sm| (sm.sm, sm.fmmu)).collect::<Vec<_>>()
    };
    assert_eq!(fmmu(fmmus, ""), [(3, Some(1)), (4, Some(2))]);
    assert_eq!(fmmu(fmmus, dc), [(4, Some(2))]);
    let unnamed = fmmus.replace(" Sm=\"4\"", "").replace(" Sm=\"3\"", "");
    assert_eq!(fmmu(&unnamed, dc), [(4, Some(1))]);
}

/// Without an index increment, one entry becomes longer, and its mapping contains the new length.
#[test]
fn samples_without_an_index_increment_lengthen_the_entry() {
    let pdo = "<TxPdo Sm=\"3\" OSFac=\"10\"><Index>#x1a08</Index><Entry><Index>#x6008</Index><SubIndex>1</SubIndex><BitLen>8</BitLen></Entry></TxPdo>";
    let mailbox = "<Mailbox><CoE PdoAssign=\"1\" PdoConfig=\"1\"/></Mailbox>";
    let selection = choose(&device(mailbox, pdo), None).unwrap();
    assert_eq!(inputs(&selection), [(0x1a08, 0x6008, 0, 80)]);
    let mapping: &[u8] = &[80, 1, 0x08, 0x60];
    assert!(written(&selection.startup).contains(&(0x1a08, 1, mapping)));
    let two = pdo.replace(
        "</TxPdo>",
        "<Entry><Index>0</Index><BitLen>3</BitLen></Entry></TxPdo>",
    );
    let selection = choose(&device("", &two.replace("\"10\"", "\"2\"")), None).unwrap();
    assert_eq!(
        inputs(&selection),
        [(0x1a08, 0x6008, 0, 8), (0x1a08, 0x6008, 11, 8)]
    );
}

#[test]
fn more_samples_than_a_frame_carries_are_rejected() {
    let dc = op_mode("DC", "<Pdo OSFac=\"101\">#x1A00</Pdo>");
    let error = choose(&device("", &format!("{SAMPLED}{dc}")), None).unwrap_err();
    assert_eq!(
        error.to_string(),
        "101 samples of PDO 0x1a00 (line 7) are more than its OSMax of 100"
    );
    let all = SAMPLED.replace(" OSMax=\"100\"", "");
    let dc = op_mode("DC", "<Pdo OSFac=\"65535\">#x1A00</Pdo>");
    let error = choose(&device("", &format!("{all}{dc}")), None).unwrap_err();
    assert!(
        error.to_string().ends_with("more than a cycle can carry"),
        "{error}"
    );
}

fn dictionary(assignment: &str) -> String {
    let record = |name: &str, of: &str, bits: u32, count: u8| {
        let items: String = (1..=count)
            .map(|sub| {
                format!("<SubItem><SubIdx>{sub}</SubIdx><Name>S{sub}</Name><Type>{of}</Type><BitSize>{bits}</BitSize></SubItem>")
            })
            .collect();
        format!(
            "<DataType><Name>{name}</Name><BitSize>1</BitSize><SubItem><SubIdx>0</SubIdx><Name>S0</Name><Type>USINT</Type><BitSize>8</BitSize></SubItem>{items}</DataType>"
        )
    };
    let object = |index: &str, of: &str, data: &[&str]| {
        let items: String = data
            .iter()
            .enumerate()
            .map(|(sub, data)| {
                format!("<SubItem><Name>S{sub}</Name><Info><DefaultData>{data}</DefaultData></Info></SubItem>")
            })
            .collect();
        format!(
            "<Object><Index>#x{index}</Index><Name>N</Name><Type>{of}</Type><Info>{items}</Info></Object>"
        )
    };
    format!(
        "<Profile><Dictionary><DataTypes>{}{}</DataTypes><Objects>{}{}{}{assignment}</Objects></Dictionary></Profile>",
        record("MAP", "UDINT", 32, 2),
        record("SET", "UINT", 16, 1),
        object("1a01", "MAP", &["01", "08020060"]),
        object("1a00", "MAP", &["02", "10010060", "04000000"]),
        object("1600", "MAP", &["01", "20010070"]),
    )
}

/// Without assignment objects, the device transmits the first mapping object of a direction.
#[test]
fn pdos_are_read_from_the_dictionary_if_no_elements_exist() {
    let mailbox = "<Mailbox><CoE/></Mailbox>";
    let selection = choose(&device(mailbox, &dictionary("")), None).unwrap();
    assert_eq!(inputs(&selection), [(0x1a00, 0x6000, 0, 16)]);
    // The gap counts as well.
    assert_eq!(selection.layout.tx_bytes(), 3);
    assert_eq!(selection.layout.rx[0].index, 0x7000);
    assert!(selection.tx[0].fixed);
    let set = "<Object><Index>#x1c13</Index><Type>SET</Type><Info><SubItem><Name>S0</Name><Info><DefaultData>01</DefaultData></Info></SubItem>\
               <SubItem><Name>S1</Name><Info><DefaultData>011a</DefaultData></Info></SubItem></Info></Object>";
    let selection = choose(&device(mailbox, &dictionary(set)), None).unwrap();
    assert_eq!(inputs(&selection), [(0x1a01, 0x6000, 0, 8)]);
}

/// A vendor's command for 0x1C13 that adapts equals the assignment that is written anyway.
#[test]
fn an_adapting_command_is_not_sent_in_addition_to_the_assignment() {
    let pdo = "<TxPdo Sm=\"3\" Fixed=\"1\"><Index>#x1a00</Index><Entry><Index>#x6000</Index><BitLen>8</BitLen></Entry></TxPdo>";
    let start = |attribute: &str| {
        let mailbox = format!(
            "<Mailbox><CoE PdoAssign=\"1\"><InitCmd><Transition>PS</Transition><Index>#x1c13</Index><SubIndex>0</SubIndex><Data{attribute}>07</Data></InitCmd></CoE></Mailbox>"
        );
        choose(&device(&mailbox, pdo), None).unwrap()
    };
    let own: &[u8] = &[7];
    let adapted = start(" AdaptAutomatically=\"1\"");
    assert!(!written(&adapted.startup).contains(&(0x1c13, 0, own)));
    assert_eq!(adapted.notes.len(), 1);
    assert!(written(&start("").startup).contains(&(0x1c13, 0, own)));
}

/// An empty mapping or assignment is written as zero only once.
#[test]
fn an_empty_pdo_is_cleared_once() {
    let mailbox = "<Mailbox><CoE PdoAssign=\"1\" PdoConfig=\"1\"/></Mailbox>";
    let file = device(
        mailbox,
        "<TxPdo Sm=\"3\"><Index>#x1a00</Index></TxPdo><RxPdo><Index>#x1600</Index></RxPdo>",
    );
    let selection = choose(&file, None).unwrap();
    let none: &[u8] = &[0];
    assert_eq!(
        written(&selection.startup),
        [
            (0x1c12, 0, none),
            (0x1c13, 0, none),
            (0x1c14, 0, none),
            (0x1a00, 0, none),
            (0x1c13, 1, &[0x00, 0x1a][..]),
            (0x1c13, 0, &[1][..]),
        ]
    );
}

#[test]
fn an_empty_flag_counts_as_absent() {
    let file = device(
        "",
        "<TxPdo Fixed=\"\" Sm=\"3\"><Index>#x1a00</Index></TxPdo>",
    );
    assert_eq!(file.warnings, []);
    assert!(!file.devices[0].tx_pdos[0].fixed);
}

/// The user must name the module of a required slot, so the file is correct.
#[test]
fn a_slot_that_needs_a_module_is_a_note() {
    let slots = "<Slots><Slot MinInstances=\"1\"><Name>A</Name><ModuleIdent>1</ModuleIdent><ModuleIdent>2</ModuleIdent></Slot></Slots>";
    let module =
        |ident: u8| format!("<Module><Type ModuleIdent=\"{ident}\">M{ident}</Type></Module>");
    let text = format!(
        "<EtherCATInfo><Vendor><Id>1</Id></Vendor><Descriptions><Devices><Device><Type ProductCode=\"1\">T</Type>{slots}</Device></Devices>\
         <Modules>{}{}</Modules></Descriptions></EtherCATInfo>",
        module(1),
        module(2)
    );
    let findings = lint(&parse(text.as_bytes()).unwrap());
    assert_eq!(findings.len(), 1);
    assert_eq!(findings[0].severity, Severity::Note);
    assert!(findings[0].message.contains("needs a module"));
}

/// A start-up command of SoE that cannot be read is left out with its line.
#[test]
fn a_damaged_idn_command_is_left_out() {
    let command = |attributes: &str, idn: &str| {
        format!(
            "<Mailbox><SoE><InitCmd{attributes}><Transition>PS</Transition>{idn}<Data>0100</Data></InitCmd></SoE></Mailbox>"
        )
    };
    for (attributes, idn) in [
        ("", ""),
        (" Chn=\"8\"", "<IDN>1</IDN>"),
        ("", "<IDN>65536</IDN>"),
    ] {
        let file = device(&command(attributes, idn), "");
        let soe = file.devices[0].soe_only().expect("SoE");
        assert!(soe.init_cmds.is_empty(), "{idn}");
        assert_eq!(lint(&file)[0].severity, Severity::Error, "{idn}");
    }
    let file = device(&command(" Chn=\"7\"", "<IDN>65535</IDN>"), "");
    let soe = file.devices[0].soe_only().expect("SoE");
    assert_eq!(
        (soe.init_cmds[0].drive, soe.init_cmds[0].idn.to_string()),
        (7, "P-7-4095".into())
    );
    assert!(lint(&file).iter().all(|f| f.severity != Severity::Error));
}

/// A virtual PDO is not an object of the device, so another PDO may have its index.
#[test]
fn a_virtual_pdo_may_share_the_index_of_another() {
    let pdo = |attributes: &str, object: &str| {
        format!(
            "<TxPdo Fixed=\"1\" Sm=\"3\" {attributes}><Index>#x1a00</Index><Entry><Index>{object}</Index><BitLen>8</BitLen></Entry></TxPdo>"
        )
    };
    let file = device("", &(pdo("Virtual=\"1\"", "#x1d09") + &pdo("", "#x6000")));
    assert_eq!(
        inputs(&choose(&file, None).unwrap()),
        [(0x1a00, 0x6000, 0, 8)]
    );
    assert_eq!(lint(&file), []);
}

/// The device decides whether it takes a command that its dictionary contradicts.
#[test]
fn commands_against_the_dictionary_are_sent_with_a_note() {
    let dictionary = "<Profile><Dictionary><DataTypes><DataType><Name>USINT</Name><BitSize>8</BitSize></DataType></DataTypes>\
        <Objects><Object><Index>#x2000</Index><Name>A</Name><Type>USINT</Type><BitSize>8</BitSize><Flags><Access>ro</Access></Flags></Object>\
        <Object><Index>#x2001</Index><Name>B</Name><Type>USINT</Type><BitSize>8</BitSize><Flags><Access>rw</Access></Flags></Object></Objects></Dictionary></Profile>";
    let notes = |index: &str, data: &str| {
        let mailbox = format!(
            "<Mailbox><CoE><InitCmd><Transition>PS</Transition><Index>{index}</Index><SubIndex>0</SubIndex><Data>{data}</Data></InitCmd></CoE></Mailbox>"
        );
        let file = device(&mailbox, dictionary);
        let selection = choose(&file, None).unwrap();
        assert_eq!(selection.startup.len(), 1);
        let found: Vec<_> = lint(&file)
            .into_iter()
            .map(|finding| finding.message)
            .collect();
        (selection.notes.join("; "), found.join("; "))
    };
    for (index, data, how) in [
        ("#x2000", "01", "0x2000:00 is read-only in the dictionary"),
        (
            "#x2001",
            "0100",
            "0x2001:00 is written with 2 bytes, the object has 1",
        ),
        ("#x2002", "01", "0x2002:00 is not in the dictionary"),
    ] {
        let (note, finding) = notes(index, data);
        assert_eq!(finding, how);
        assert!(
            note.contains(how) && note.ends_with("it is sent all the same"),
            "{note}"
        );
    }
    assert_eq!(notes("#x2001", "01"), (String::new(), String::new()));
}

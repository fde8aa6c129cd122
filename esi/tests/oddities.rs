//! Unusual but valid choices of vendor files: repeated objects, Excludes, empty lists, mappings
//! without PDO elements, and SYNC1.

use ecaxis_esi::{
    EntryRef, Mode, SelectOptions, Selection, find_device, offered_modes, parse, select,
};

const MS: u64 = 1_000_000;

/// Returns a drive with a mailbox and four SyncManagers that contains `inside`.
fn drive(coe: &str, inside: &str, dc: &str) -> Vec<u8> {
    format!(
        "<EtherCATInfo><Vendor><Id>1</Id></Vendor><Descriptions><Devices><Device Physics=\"YY\">\
         <Type ProductCode=\"1\" RevisionNo=\"1\">D</Type>\
         <Sm StartAddress=\"#x1000\" DefaultSize=\"128\">MBoxOut</Sm>\
         <Sm StartAddress=\"#x1080\" DefaultSize=\"128\">MBoxIn</Sm>\
         <Sm StartAddress=\"#x1100\">Outputs</Sm><Sm StartAddress=\"#x1180\">Inputs</Sm>\
         {inside}<Mailbox><CoE {coe}/></Mailbox>{dc}</Device></Devices></Descriptions></EtherCATInfo>"
    )
    .into_bytes()
}

const FREE: &str = "PdoAssign=\"1\" PdoConfig=\"1\"";
const STATUS: &str = "<TxPdo Fixed=\"1\" Sm=\"3\"><Index>#x1A00</Index>\
    <Entry><Index>#x6041</Index><BitLen>16</BitLen></Entry>\
    <Entry><Index>#x6064</Index><BitLen>32</BitLen></Entry></TxPdo>";

fn pdo(kind: &str, attributes: &str, index: u16, objects: &[(u16, u8)]) -> String {
    pdo_excluding(kind, attributes, index, objects, "")
}

fn pdo_excluding(
    kind: &str,
    attributes: &str,
    index: u16,
    objects: &[(u16, u8)],
    exclude: &str,
) -> String {
    let entries: String = objects
        .iter()
        .map(|(index, bits)| {
            format!("<Entry><Index>#x{index:04X}</Index><BitLen>{bits}</BitLen></Entry>")
        })
        .collect();
    format!("<{kind} {attributes}><Index>#x{index:04X}</Index>{exclude}{entries}</{kind}>")
}

fn choose(bytes: &[u8], choice: &SelectOptions<'_>) -> Selection {
    let file = parse(bytes).unwrap();
    assert_eq!(file.warnings, []);
    let device = find_device(&file, &Default::default()).unwrap();
    select(&file, device, choice).unwrap_or_else(|error| panic!("{error}"))
}

fn in_mode(bytes: &[u8], mode: Mode) -> Selection {
    let choice = SelectOptions {
        mode: Some(mode),
        cycle_ns: MS,
        ..SelectOptions::default()
    };
    choose(bytes, &choice)
}

fn rx(selection: &Selection) -> Vec<u16> {
    selection.rx.iter().map(|pdo| pdo.index).collect()
}

fn tx(selection: &Selection) -> Vec<u16> {
    selection.tx.iter().map(|pdo| pdo.index).collect()
}

const CONTROL: (u16, u8) = (0x6040, 16);
const POSITION: (u16, u8) = (0x607a, 32);
const VELOCITY: (u16, u8) = (0x60ff, 32);

/// ETG.2000, `RxPdo/@Sm`: the default assignment; PDOs without `Sm` can replace it. One PDO per
/// mode, all with the Controlword: the drive must see one Controlword.
#[test]
fn the_pdo_of_the_mode_replaces_a_default_pdo_with_its_objects() {
    let csp = pdo("RxPdo", "Fixed=\"1\"", 0x1601, &[CONTROL, POSITION]);
    let csv = pdo("RxPdo", "Fixed=\"1\"", 0x1602, &[CONTROL, VELOCITY]);
    let plain = pdo("RxPdo", "Fixed=\"1\" Sm=\"2\"", 0x1600, &[CONTROL]);
    let file = drive(FREE, &[&*plain, &csp, &csv, STATUS].concat(), "");
    assert_eq!(rx(&in_mode(&file, Mode::Csp)), [0x1601]);
    let selection = in_mode(&file, Mode::Csv);
    assert_eq!(rx(&selection), [0x1602]);
    let note = &selection.notes[0];
    assert!(
        note.contains("0x1600 is assigned by default and left out"),
        "{note}"
    );
    // A PDO with a further object stays; so does a mandatory one.
    for (attributes, objects) in [
        ("Fixed=\"1\" Sm=\"2\"", &[CONTROL, (0x60fe, 32)][..]),
        ("Fixed=\"1\" Sm=\"2\" Mandatory=\"1\"", &[CONTROL][..]),
    ] {
        let kept = pdo("RxPdo", attributes, 0x1600, objects);
        let file = drive(FREE, &[&*kept, &csp, STATUS].concat(), "");
        assert_eq!(rx(&in_mode(&file, Mode::Csp)), [0x1601, 0x1600]);
    }
    // A device that assigns its PDOs itself keeps them.
    let both = [
        pdo("RxPdo", "Fixed=\"1\" Sm=\"2\"", 0x1600, &[CONTROL]),
        pdo(
            "RxPdo",
            "Fixed=\"1\" Sm=\"2\"",
            0x1601,
            &[CONTROL, POSITION],
        ),
    ];
    let file = drive("", &(both.concat() + STATUS), "");
    assert_eq!(rx(&in_mode(&file, Mode::Csp)), [0x1600, 0x1601]);
    let file = drive(FREE, &(both.concat() + STATUS), "");
    assert_eq!(rx(&in_mode(&file, Mode::Csp)), [0x1601]);
}

/// ETG.6010: CSV and CST need their set-point and the actual value; the position is optional.
#[test]
fn velocity_mode_keeps_the_position_that_a_pdo_contains() {
    let csv = pdo(
        "RxPdo",
        "Fixed=\"1\" Sm=\"2\"",
        0x1600,
        &[CONTROL, VELOCITY],
    );
    let speed = [(0x6041, 16), (0x606c, 32)];
    let all = [(0x6041, 16), (0x606c, 32), (0x6064, 32)];
    // The default has the position.
    let inputs = pdo("TxPdo", "Fixed=\"1\"", 0x1a01, &speed);
    let file = drive(FREE, &[&csv, STATUS, &inputs].concat(), "");
    assert_eq!(tx(&in_mode(&file, Mode::Csv)), [0x1a01, 0x1a00]);
    // Another PDO has the position alone.
    let inputs = pdo("TxPdo", "Fixed=\"1\" Sm=\"3\"", 0x1a01, &speed)
        + &pdo("TxPdo", "Fixed=\"1\"", 0x1a02, &[(0x6064, 32)]);
    let file = drive(FREE, &[&*csv, &inputs].concat(), "");
    assert_eq!(tx(&in_mode(&file, Mode::Csv)), [0x1a01, 0x1a02]);
    // Another PDO has everything and excludes the default.
    let inputs = pdo("TxPdo", "Fixed=\"1\" Sm=\"3\"", 0x1a01, &speed)
        + &pdo_excluding(
            "TxPdo",
            "Fixed=\"1\"",
            0x1a02,
            &all,
            "<Exclude>#x1A01</Exclude>",
        );
    let file = drive(FREE, &[&*csv, &inputs].concat(), "");
    assert_eq!(tx(&in_mode(&file, Mode::Csv)), [0x1a02]);
    // No PDO has the position.
    let inputs = pdo("TxPdo", "Fixed=\"1\" Sm=\"3\"", 0x1a01, &speed);
    let file = drive(FREE, &[&*csv, &inputs].concat(), "");
    assert_eq!(tx(&in_mode(&file, Mode::Csv)), [0x1a01]);
}

/// ETG.2000: an `OpMode` lists the PDOs that it needs, even if other elements exclude them.
#[test]
fn a_named_assignment_wins_over_exclude() {
    let pdos = pdo("RxPdo", "Fixed=\"1\" Sm=\"2\"", 0x1600, &[CONTROL])
        + &pdo_excluding(
            "RxPdo",
            "Fixed=\"1\"",
            0x1601,
            &[POSITION],
            "<Exclude>#x1600</Exclude>",
        )
        + STATUS;
    let mode = |sm2: &str| {
        format!(
            "<Dc><OpMode><Name>DC</Name><AssignActivate>#x300</AssignActivate>\
             <CycleTimeSync0 Factor=\"1\">0</CycleTimeSync0>{sm2}</OpMode></Dc>"
        )
    };
    let listed = "<Sm No=\"2\"><Pdo>#x1600</Pdo><Pdo>#x1601</Pdo></Sm>";
    let selection = in_mode(&drive(FREE, &pdos, &mode(listed)), Mode::Csp);
    assert_eq!(rx(&selection), [0x1600, 0x1601]);
    let excluded = selection
        .notes
        .iter()
        .find(|note| note.contains("excluded"));
    assert_eq!(excluded, None);
}

/// ETG.2000, `OpMode/Sm/Pdo`: optional. Without it, the `Sm` attributes of the PDOs apply.
#[test]
fn a_sync_manager_of_an_opmode_without_pdos_keeps_the_default() {
    let pdos = pdo(
        "RxPdo",
        "Fixed=\"1\" Sm=\"2\"",
        0x1600,
        &[CONTROL, POSITION],
    ) + &pdo("RxPdo", "Fixed=\"1\"", 0x1601, &[CONTROL, VELOCITY])
        + STATUS;
    let dc = "<Dc><OpMode><Name>DC</Name><AssignActivate>#x300</AssignActivate>\
        <CycleTimeSync0 Factor=\"1\">0</CycleTimeSync0><Sm No=\"2\"/><Sm No=\"3\"/></OpMode></Dc>";
    let selection = in_mode(&drive(FREE, &pdos, dc), Mode::Csp);
    assert_eq!(
        (rx(&selection), tx(&selection)),
        (vec![0x1600], vec![0x1a00])
    );
}

fn object(index: u16, kind: &str, bits: u16, access: &str) -> String {
    format!(
        "<Object><Index>#x{index:04X}</Index><Name>o</Name><Type>{kind}</Type>\
         <BitSize>{bits}</BitSize><Flags>{access}</Flags></Object>"
    )
}

/// ETG.1000.6, PDO mapping: a writable 0x1600 or 0x1A00 can be configured, also if no `RxPdo`
/// describes it.
#[test]
fn a_mapping_that_only_the_dictionary_has_takes_the_objects_of_the_mode() {
    let mapping = "<DataType><Name>MAP</Name><BitSize>80</BitSize>\
        <SubItem><SubIdx>0</SubIdx><Name>n</Name><Type>USINT</Type><BitSize>8</BitSize>\
        <BitOffs>0</BitOffs><Flags><Access>rw</Access></Flags></SubItem>\
        <SubItem><SubIdx>1</SubIdx><Name>a</Name><Type>UDINT</Type><BitSize>32</BitSize>\
        <BitOffs>16</BitOffs><Flags><Access>rw</Access></Flags></SubItem>\
        <SubItem><SubIdx>2</SubIdx><Name>b</Name><Type>UDINT</Type><BitSize>32</BitSize>\
        <BitOffs>48</BitOffs><Flags><Access>rw</Access></Flags></SubItem></DataType>";
    let plain = ["USINT", "UINT", "UDINT", "DINT"]
        .iter()
        .zip([8, 16, 32, 32])
        .map(|(name, bits)| {
            format!("<DataType><Name>{name}</Name><BitSize>{bits}</BitSize></DataType>")
        });
    let types: String = plain.chain([mapping.to_owned()]).collect();
    let rx_flag = "<Access>rw</Access><PdoMapping>R</PdoMapping>";
    let tx_flag = "<Access>ro</Access><PdoMapping>T</PdoMapping>";
    let objects = [
        object(0x1600, "MAP", 80, "<Access>rw</Access>"),
        object(0x1a00, "MAP", 80, "<Access>rw</Access>"),
        object(0x1c12, "MAP", 80, "<Access>rw</Access>"),
        object(0x1c13, "MAP", 80, "<Access>rw</Access>"),
        object(0x6040, "UINT", 16, rx_flag),
        object(0x607a, "DINT", 32, rx_flag),
        object(0x6041, "UINT", 16, tx_flag),
        object(0x6064, "DINT", 32, tx_flag),
    ];
    let profile = format!(
        "<Profile><Dictionary><DataTypes>{types}</DataTypes><Objects>{}</Objects></Dictionary></Profile>",
        objects.concat()
    );
    let file = drive("SdoInfo=\"1\"", &profile, "");
    let selection = in_mode(&file, Mode::Csp);
    assert_eq!(
        (rx(&selection), tx(&selection)),
        (vec![0x1600], vec![0x1a00])
    );
    assert_eq!(
        (selection.layout.rx_bytes(), selection.layout.tx_bytes()),
        (6, 6)
    );
    assert!(
        selection.notes[0].contains("no PDO of the ESI has them"),
        "{:?}",
        selection.notes
    );
    let written: Vec<_> = selection
        .startup
        .iter()
        .filter(|sdo| sdo.index == 0x1600)
        .map(|sdo| (sdo.sub, sdo.data.clone()))
        .collect();
    assert_eq!(
        written,
        [
            (0, vec![0]),
            (1, 0x6040_0010_u32.to_le_bytes().to_vec()),
            (2, 0x607a_0020_u32.to_le_bytes().to_vec()),
            (0, vec![2]),
        ]
    );
    let parsed = parse(&file).unwrap();
    assert_eq!(
        offered_modes(&parsed, &parsed.devices[0]),
        [Mode::Pp, Mode::Csp]
    );
    // The user's own contents.
    let list = [EntryRef {
        index: 0x6040,
        sub: 0,
    }];
    let choice = SelectOptions {
        rx: Some(&list),
        cycle_ns: MS,
        ..SelectOptions::default()
    };
    assert_eq!(choose(&file, &choice).layout.rx_bytes(), 2);
}

/// The empty mapping object of a drive with other PDOs is used only where these lack the Statusword
/// or the set-point.
#[test]
fn an_empty_mapping_object_leaves_a_usable_default_alone() {
    let status = pdo(
        "TxPdo",
        "Fixed=\"1\" Sm=\"3\" Mandatory=\"1\"",
        0x1a00,
        &[(0x6041, 16), (0x6064, 32)],
    );
    let empty = pdo("TxPdo", "", 0x1a07, &[]);
    let csv = pdo(
        "RxPdo",
        "Fixed=\"1\" Sm=\"2\"",
        0x1600,
        &[CONTROL, VELOCITY],
    );
    let speed = "<Profile><Dictionary><DataTypes><DataType><Name>DINT</Name><BitSize>32</BitSize>\
        </DataType></DataTypes><Objects><Object><Index>#x606C</Index><Name>v</Name><Type>DINT</Type>\
        <BitSize>32</BitSize><Flags><Access>ro</Access><PdoMapping>T</PdoMapping></Flags></Object>\
        </Objects></Dictionary></Profile>";
    for coe in [FREE, "PdoConfig=\"1\""] {
        let file = drive(coe, &[speed, &csv, &status, &empty].concat(), "");
        let selection = in_mode(&file, Mode::Csv);
        assert_eq!(tx(&selection), [0x1a00], "{coe}");
        let note = selection.notes.iter().any(|note| note.contains("0x606c"));
        assert!(note, "{:?}", selection.notes);
    }
}

/// SOEM, `ecx_dcsync01`: the period of SYNC1 (`TrueCyclTime`) from the cycle of SYNC0 and 0x09A4.
fn soem_true_cycle_time(sync0: u32, delay: u32) -> u32 {
    (delay / sync0 + 1) * sync0
}

/// Register 0x09A4 is the time from SYNC0 to SYNC1 (ET1100 data sheet, section I, 9.2.3). Rows:
///
/// - EL7201 and EL3174, ESI: factor 1, shift 1,000 and 25,000.
/// - EL3702 with 4 samples: factors -4 and -1 (EtherLab), 750,000 in 0x09A4 at 1 ms (`ecmccfg`, used
///   with the terminal; TwinCAT's values, the cycles themselves, make the period too long there).
/// - EL1262 with 10 samples and AX5000, ESI: factors -10 and -1; 125 µs and factor -1.
///
/// The period of SYNC1 that SOEM computes from the two registers is the SYNC1 cycle of the ESI. No ENI
/// file among the fixtures has a command for 0x09A4.
#[test]
fn sync1_is_the_delay_after_sync0() {
    const MS: u32 = 1_000_000;
    let rows = [
        // (SYNC0 and SYNC1 text, shift, AssignActivate, SYNC0 cycle, 0x09A4, period of SYNC1)
        (
            "Factor=\"1\">0",
            "Factor=\"1\">0",
            1_000,
            "#x700",
            MS,
            1_000,
            MS,
        ),
        (
            "Factor=\"1\">0",
            "Factor=\"1\">0",
            25_000,
            "#x700",
            MS,
            25_000,
            MS,
        ),
        (
            "Factor=\"-4\">0",
            "Factor=\"-1\">0",
            0,
            "#x730",
            250_000,
            750_000,
            MS,
        ),
        (
            "Factor=\"-4\">0",
            "Factor=\"1\">0",
            0,
            "#x700",
            250_000,
            750_000,
            MS,
        ),
        (
            "Factor=\"-10\">0",
            "Factor=\"-1\">0",
            0,
            "#x730",
            100_000,
            900_000,
            MS,
        ),
        (
            ">125000",
            "Factor=\"-1\">0",
            0,
            "#x730",
            125_000,
            875_000,
            MS,
        ),
        ("Factor=\"1\">0", "Factor=\"-1\">0", 0, "#x700", MS, 0, MS),
        (
            "Factor=\"1\">0",
            "Factor=\"2\">0",
            0,
            "#x700",
            MS,
            MS,
            2 * MS,
        ),
        ("Factor=\"1\">0", ">4000000", 0, "#x700", MS, 3 * MS, 4 * MS),
        (
            "Factor=\"1\">0",
            "Factor=\"0\">0",
            500,
            "#x700",
            MS,
            500,
            MS,
        ),
        // SYNC1 alone counts from a SYNC0 without output.
        (
            "Factor=\"1\">0",
            "Factor=\"1\">0",
            1_000,
            "#x500",
            MS,
            1_000,
            MS,
        ),
        (
            ">0",
            "Factor=\"2\">0",
            1_000,
            "#x500",
            MS,
            MS + 1_000,
            2 * MS,
        ),
        (
            "Factor=\"1\">0",
            "Factor=\"1\">0",
            1_000,
            "#x300",
            MS,
            0,
            MS,
        ),
        // SYNC1 cannot come before SYNC0.
        (
            "Factor=\"1\">0",
            "Factor=\"-4\">0",
            0,
            "#x700",
            MS,
            250_000,
            MS,
        ),
        (
            "Factor=\"1\">0",
            "Factor=\"1\">0",
            -100,
            "#x700",
            MS,
            999_900,
            MS,
        ),
    ];
    let pdos = pdo(
        "RxPdo",
        "Fixed=\"1\" Sm=\"2\"",
        0x1600,
        &[CONTROL, POSITION],
    ) + STATUS;
    for (sync0_text, sync1, shift, activate, sync0, delay, period) in rows {
        let dc = format!(
            "<Dc><OpMode><Name>DC</Name><AssignActivate>{activate}</AssignActivate>\
             <CycleTimeSync0 {sync0_text}</CycleTimeSync0>\
             <CycleTimeSync1 {sync1}</CycleTimeSync1><ShiftTimeSync1>{shift}</ShiftTimeSync1>\
             </OpMode></Dc>"
        );
        let dc = in_mode(&drive(FREE, &pdos, &dc), Mode::Csp).dc.unwrap();
        assert_eq!(
            (dc.sync0_cycle_ns, dc.sync1_delay_ns),
            (sync0, delay),
            "{sync0_text}, {sync1}"
        );
        assert_eq!(soem_true_cycle_time(sync0, delay), period, "{sync1}");
        assert_eq!(dc.activates_sync1(), activate != "#x300");
    }
}

/// CiA 402: the values of a drive have subindex 0. A file that maps another one, or no Controlword,
/// is refused with the reason, and offers no mode.
#[test]
fn a_drive_whose_pdos_lack_the_values_of_the_mode_is_refused_with_the_reason() {
    let good = pdo(
        "RxPdo",
        "Fixed=\"1\" Sm=\"2\"",
        0x1600,
        &[CONTROL, POSITION],
    ) + STATUS;
    let target = "<Index>#x607A</Index>";
    for (rx, reason) in [
        (
            good.replace(target, &format!("{target}<SubIndex>4</SubIndex>")),
            "D: mode csp needs 0x607A:00; line 1 maps 0x607A:04",
        ),
        (
            good.replace("<Index>#x6040</Index>", "<Index>#x6041</Index>"),
            "D has no mode csp: no RxPdo of the ESI has the Controlword 0x6040",
        ),
    ] {
        let file = parse(&drive("", &rx, "")).unwrap();
        let device = &file.devices[0];
        let choice = SelectOptions {
            mode: Some(Mode::Csp),
            cycle_ns: MS,
            ..SelectOptions::default()
        };
        let error = select(&file, device, &choice).unwrap_err();
        assert_eq!(error.to_string(), reason);
        assert_eq!(offered_modes(&file, device), []);
    }
}

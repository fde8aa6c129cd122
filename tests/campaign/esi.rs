//! ESI files of the campaign: the EPOS4 of the demonstration with further objects.

use std::fmt::Write as _;

/// A subindex of a record: its number, type, size in bits and default.
type Element = (u8, &'static str, usize, u32);

/// Returns the ESI of the EPOS4.
fn epos4() -> String {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/esi/EPOS4.xml");
    std::fs::read_to_string(path).expect("our file")
}

/// Adds a record, whose elements can be mapped as inputs if `mapped`.
fn with_record(esi: &str, index: u16, elements: &[Element], mapped: bool) -> String {
    let access = if mapped { "ro" } else { "rw" };
    let map = if mapped {
        "<PdoMapping>T</PdoMapping>"
    } else {
        ""
    };
    let last = elements.last().map_or(0, |element| u32::from(element.0));
    let mut at = 0;
    let mut types = String::new();
    let mut values = String::new();
    for (sub, kind, bits, value) in [(0, "USINT", 8, last)].iter().chain(elements) {
        let rights = if *sub == 0 { "ro" } else { access };
        let _ = write!(
            types,
            "<SubItem><SubIdx>{sub}</SubIdx><Name>Element {sub}</Name><Type>{kind}</Type><BitSize>{bits}</BitSize>\
             <BitOffs>{at}</BitOffs><Flags><Access>{rights}</Access>{map}</Flags></SubItem>"
        );
        let _ = write!(
            values,
            "<SubItem><Name>Element {sub}</Name><Info><DefaultValue>{value}</DefaultValue></Info></SubItem>"
        );
        // The first element begins at a word.
        at += (*bits).max(16);
    }
    let name = format!("DT{index:04X}");
    let data_type =
        format!("<DataType><Name>{name}</Name><BitSize>{at}</BitSize>{types}</DataType>");
    let object = format!(
        "<Object><Index>#x{index:04X}</Index><Name>Record {index:04X}</Name><Type>{name}</Type><BitSize>{at}</BitSize>\
         <Info>{values}</Info><Flags><Access>{access}</Access>{map}</Flags></Object>"
    );
    with(esi, &data_type, &object)
}

fn with(esi: &str, data_types: &str, objects: &str) -> String {
    let types = "</DataTypes>";
    let esi = esi.replacen(types, &format!("{data_types}{types}"), 1);
    let end = "</Objects>";
    esi.replacen(end, &format!("{objects}{end}"), 1)
}

/// Adds a position of the load.
pub fn with_load_position() -> String {
    with_record(&epos4(), 0x60e4, &[(1, "DINT", 32, 0)], true)
}

/// Adds a gear: this many counts of the encoder are that many units of positions.
pub fn with_gear(counts: u32, units: u32) -> String {
    let elements = [(1, "UDINT", 32, counts), (2, "UDINT", 32, units)];
    with_record(&epos4(), 0x6091, &elements, false)
}

/// Adds a polarity.
pub fn with_polarity() -> String {
    let object = "<Object><Index>#x607E</Index><Name>Polarity</Name><Type>USINT</Type><BitSize>8</BitSize>\
        <Info><DefaultValue>0</DefaultValue></Info><Flags><Access>rw</Access></Flags></Object>";
    with(&epos4(), "", object)
}

/// Objects of maxon's EPOS4 that belong to one unit, or whose write is a command (FW specification
/// of the EPOS4, sections on 0x2EC0, 0x30B5 and 0x3241).
pub const OF_A_UNIT: [(u16, &[u8]); 3] = [
    (0x2ec0, &[1]),
    (0x30b5, &[1, 2]),
    (0x3241, &[1, 2, 3, 4, 5, 6]),
];

/// Adds data of one unit, in a drive with the number of its vendor.
pub fn with_unit_data(vendor: u32) -> String {
    let esi = epos4().replacen("#x00000E0A", &format!("#x{vendor:08X}"), 1);
    OF_A_UNIT.iter().fold(esi, |esi, (index, subs)| {
        let elements: Vec<Element> = subs.iter().map(|&sub| (sub, "UDINT", 32, 0)).collect();
        with_record(&esi, *index, &elements, false)
    })
}

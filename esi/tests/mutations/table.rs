//! Where the file is damaged, and what is said of it.

pub struct Mutation {
    pub name: &'static str,
    pub damage: fn(String) -> String,
    pub says: Says,
}

pub struct Says {
    /// `refused`: nothing can be read; else the severity of a finding.
    pub kind: &'static str,
    pub at: At,
    pub path: &'static str,
    /// Part of it.
    pub text: &'static str,
}

/// A place of the damaged text.
pub enum At {
    First(&'static str),
    /// Counted from 1.
    Nth(usize, &'static str),
    Last(&'static str),
    /// The last of the second before the first of the first.
    Before(&'static str, &'static str),
}

impl At {
    pub fn find(&self, text: &str) -> Option<usize> {
        match self {
            Self::First(part) => text.find(part),
            Self::Nth(number, part) => text.match_indices(part).nth(number - 1).map(|(at, _)| at),
            Self::Last(part) => text.rfind(part),
            Self::Before(end, part) => text[..text.find(end)?].rfind(part),
        }
    }
}

fn replace(text: &str, from: &str, to: &str) -> String {
    assert!(text.contains(from), "{from}");
    text.replacen(from, to, 1)
}

/// The first `from` behind `behind`.
fn replace_in(text: &str, behind: &str, from: &str, to: &str) -> String {
    let (before, after) = text.split_once(behind).unwrap();
    format!("{before}{behind}{}", replace(after, from, to))
}

fn insert(text: &str, before: &str, new: &str) -> String {
    replace(text, before, &format!("{new}{before}"))
}

fn cut(mut text: String, at: &str) -> String {
    text.truncate(text.rfind(at).unwrap());
    text
}

fn cut_first(mut text: String, at: &str) -> String {
    text.truncate(text.find(at).unwrap());
    text
}

/// Two megabytes of objects in the default module.
fn large_module(text: &str) -> String {
    let object = "<Object><Index>#x4000</Index><Type>BIG</Type><BitSize>80000</BitSize></Object>";
    let objects = format!("<Objects>{}", object.repeat(200));
    replace_in(text, "ModuleIdent=\"#x6800000C\">", "<Objects>", &objects)
}

fn instances(text: &str, count: &str) -> String {
    let text = replace(text, "MaxSlotCount=\"1\" ", "");
    let both = format!("<Slot MinInstances=\"{count}\" MaxInstances=\"{count}\"");
    replace(&text, "<Slot MinInstances=\"1\" MaxInstances=\"1\"", &both)
}

fn slots(text: &str, count: usize) -> String {
    let text = replace(text, "MaxSlotCount=\"1\" ", "");
    let slot =
        "<Slot MinInstances=\"1\"><Name>S</Name><ModuleIdent>#x6800000C</ModuleIdent></Slot>";
    insert(&text, "</Slots>", &slot.repeat(count))
}

/// Small copies of the device, each with places enough.
fn doubled(text: &str, count: usize) -> String {
    let device = "<Device Physics=\"YY\"><Type ProductCode=\"#x69500000\" RevisionNo=\"#x01700000\">E</Type>\
                  <Slots><Slot MinInstances=\"254\" MaxInstances=\"254\"><ModuleIdent>1</ModuleIdent></Slot></Slots></Device>";
    let module = "<Module><Type ModuleIdent=\"1\">M</Type></Module>";
    let text = insert(text, "</Devices>", &device.repeat(count));
    insert(&text, "</Modules>", module)
}

fn long_type(text: &str) -> String {
    let name = "T".repeat(2_000_000);
    let types = format!(
        "<DataType><Name>LONGARR</Name><BaseType>{name}</BaseType><BitSize>2040</BitSize><ArrayInfo><LBound>1</LBound><Elements>255</Elements></ArrayInfo></DataType>\
         <DataType><Name>LONG</Name><BitSize>2056</BitSize><SubItem><SubIdx>0</SubIdx><Type>USINT</Type><BitSize>8</BitSize></SubItem>\
         <SubItem><Name>Elements</Name><Type>LONGARR</Type><BitSize>2040</BitSize></SubItem></DataType>"
    );
    let text = insert(text, "<DataType>", &types);
    let object = "<Object><Index>#x4000</Index><Type>LONG</Type><BitSize>2056</BitSize></Object>";
    insert(&text, "<Object>", object)
}

/// Ten times ten times ten …
fn bomb(text: &str) -> String {
    let entities: String = (1..10)
        .map(|n| {
            format!(
                "<!ENTITY lol{n} \"{}\">",
                format!("&lol{};", n - 1).repeat(10)
            )
        })
        .collect();
    let doctype = format!("<!DOCTYPE lolz [<!ENTITY lol0 \"lol\">{entities}]>\n<EtherCATInfo ");
    let text = replace(text, "<EtherCATInfo ", &doctype);
    replace(&text, "<Name>EPOS4 Micro", "<Name>EPOS4 Micro&lol9;")
}

const fn says(kind: &'static str, at: At, path: &'static str, text: &'static str) -> Says {
    Says {
        kind,
        at,
        path,
        text,
    }
}

pub const MUTATIONS: &[Mutation] = &[
    Mutation {
        name: "cut inside the XML declaration",
        damage: |text| cut(text, r##" encoding="iso"##),
        says: says("refused", At::First("<?xml"), "", "syntax"),
    },
    Mutation {
        name: "cut inside the vendor's id",
        damage: |text| cut(text, "000000FB"),
        says: says(
            "refused",
            At::First("<Id>"),
            "EtherCATInfo/Vendor/Id",
            "ends inside <Id>",
        ),
    },
    Mutation {
        name: "cut inside a start tag",
        damage: |text| cut(text, r##" DefaultSize="48" StartAddress="#x1000""##),
        says: says(
            "refused",
            At::First("<Sm MinSize"),
            "EtherCATInfo/Descriptions/Devices/Device[1]",
            "syntax",
        ),
    },
    Mutation {
        name: "cut inside the data types",
        damage: |text| cut_first(text, "<BitSize>40"),
        says: says(
            "refused",
            At::First("<DataType>\n                <Name>STRING(5)"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/Profile/Dictionary/DataTypes/DataType[3]",
            "ends inside <DataType>",
        ),
    },
    Mutation {
        name: "cut inside the last module",
        damage: |text| cut(text, r##"#x6A00000C">"##),
        says: says(
            "refused",
            At::Last("<Type ModuleIdent"),
            "EtherCATInfo/Descriptions/Modules/Module[5]",
            "syntax",
        ),
    },
    Mutation {
        name: "cut before the root ends",
        damage: |text| cut(text, "</EtherCATInfo>"),
        says: says(
            "refused",
            At::First("<EtherCATInfo "),
            "EtherCATInfo",
            "ends inside <EtherCATInfo>",
        ),
    },
    Mutation {
        name: "an end tag is missing",
        damage: |text| replace(&text, "</GroupType>\n", "\n"),
        says: says(
            "refused",
            At::First("</Device>"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/GroupType",
            "expected `</GroupType>`",
        ),
    },
    Mutation {
        name: "nothing at all",
        damage: |_| String::new(),
        says: says("refused", At::First(""), "", "no XML element"),
    },
    Mutation {
        name: "a comment that never ends",
        damage: |text| replace(&text, "<Fmmu>Outputs", "<!- - <Fmmu>Outputs"),
        says: says(
            "refused",
            At::First("<!- -"),
            "EtherCATInfo/Descriptions/Devices/Device[1]",
            "syntax",
        ),
    },
    Mutation {
        name: "another root",
        damage: |text| text.replace("EtherCATInfo", "EtherCATConfig"),
        says: says(
            "refused",
            At::First("<EtherCATConfig "),
            "EtherCATConfig",
            "root element is <EtherCATConfig>",
        ),
    },
    Mutation {
        name: "no vendor",
        damage: |text| text.replace("Vendor>", "Seller>"),
        says: says(
            "refused",
            At::First("<EtherCATInfo "),
            "EtherCATInfo",
            "Vendor is missing",
        ),
    },
    Mutation {
        name: "a doubled PDO index",
        damage: |text| {
            replace_in(
                &text,
                "<RxPdo ",
                "<Index>#x1601</Index>",
                "<Index>#x1600</Index>",
            )
        },
        says: says(
            "warning",
            At::Nth(2, "<RxPdo "),
            "Device[1]/RxPdo[2]",
            "described twice, first on line 8074",
        ),
    },
    Mutation {
        name: "a PDO entry without an index",
        damage: |text| {
            replace(
                &text,
                "<Entry>\n            <Index>#x6040</Index>",
                "<Entry>",
            )
        },
        says: says(
            "refused",
            At::First("<Entry>"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]/Entry[1]",
            "Entry/Index is missing",
        ),
    },
    Mutation {
        name: "a PDO without an index",
        damage: |text| replace_in(&text, "<RxPdo ", "<Index>#x1602</Index>", ""),
        says: says(
            "refused",
            At::Nth(3, "<RxPdo "),
            "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[3]",
            "PDO Index is missing",
        ),
    },
    Mutation {
        name: "a PDO that excludes itself",
        damage: |text| {
            replace(
                &text,
                "<Exclude>#x1601</Exclude>",
                "<Exclude>#x1600</Exclude>",
            )
        },
        says: says(
            "warning",
            At::Nth(1, "<RxPdo "),
            "Device[1]/RxPdo[1]",
            "excludes itself",
        ),
    },
    Mutation {
        name: "a bit length of 0",
        damage: |text| replace(&text, "<BitLen>16</BitLen>", "<BitLen>0</BitLen>"),
        says: says(
            "warning",
            At::First("<Entry>"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]/Entry[1]",
            "bit length of 0",
        ),
    },
    Mutation {
        name: "a bit length beyond 16 bits",
        damage: |text| replace(&text, "<BitLen>16</BitLen>", "<BitLen>65536</BitLen>"),
        says: says(
            "refused",
            At::First("<BitLen>"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]/Entry[1]/BitLen",
            r##""65536" is not a number that fits"##,
        ),
    },
    Mutation {
        name: "a negative bit length",
        damage: |text| replace(&text, "<BitLen>16</BitLen>", "<BitLen>-16</BitLen>"),
        says: says(
            "refused",
            At::First("<BitLen>"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]/Entry[1]/BitLen",
            r##""-16""##,
        ),
    },
    Mutation {
        name: "a bit length beyond a frame",
        damage: |text| replace(&text, "<BitLen>16</BitLen>", "<BitLen>65535</BitLen>"),
        says: says(
            "warning",
            At::First("<Entry>"),
            "Device[1]/RxPdo[1]/Entry[1]",
            "more than a frame carries",
        ),
    },
    Mutation {
        name: "a subindex of 256",
        damage: |text| replace(&text, "<SubIndex>0</SubIndex>", "<SubIndex>256</SubIndex>"),
        says: says(
            "refused",
            At::First("<SubIndex>256"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]/Entry[1]/SubIndex",
            r##""256""##,
        ),
    },
    Mutation {
        name: "a PDO of a SyncManager that is not there",
        damage: |text| {
            replace(
                &text,
                r##"<RxPdo Fixed="false" Sm="2""##,
                r##"<RxPdo Fixed="false" Sm="9""##,
            )
        },
        says: says(
            "warning",
            At::Nth(1, "<RxPdo "),
            "Device[1]/RxPdo[1]",
            "Sm 9, and the device has 4",
        ),
    },
    Mutation {
        name: "a PDO of SyncManager 300",
        damage: |text| {
            replace(
                &text,
                r##"<RxPdo Fixed="false" Sm="2""##,
                r##"<RxPdo Fixed="false" Sm="300""##,
            )
        },
        says: says(
            "refused",
            At::Nth(1, "<RxPdo "),
            "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]",
            r##"Sm "300""##,
        ),
    },
    Mutation {
        name: "an output PDO of an input SyncManager",
        damage: |text| {
            replace(
                &text,
                r##"<RxPdo Fixed="false" Sm="2""##,
                r##"<RxPdo Fixed="false" Sm="3""##,
            )
        },
        says: says(
            "warning",
            At::Nth(1, "<RxPdo "),
            "Device[1]/RxPdo[1]",
            "for Inputs and not for Outputs",
        ),
    },
    Mutation {
        name: "3000 PDOs",
        damage: |text| {
            insert(
                &text,
                "<TxPdo ",
                &"<TxPdo><Index>#x1a00</Index></TxPdo>".repeat(3000),
            )
        },
        says: says(
            "refused",
            At::Nth(2049, "<TxPdo"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/TxPdo[2049]",
            "the PDOs of one direction exceed 2048",
        ),
    },
    Mutation {
        name: "20000 entries in a PDO",
        damage: |text| {
            insert(
                &text,
                "<Entry>",
                &"<Entry><Index>0</Index></Entry>".repeat(20_000),
            )
        },
        says: says(
            "refused",
            At::Nth(12001, "<Entry>"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]/Entry[12001]",
            "a PDO's entries exceed 12000",
        ),
    },
    Mutation {
        name: "65535 samples of a PDO",
        damage: |text| replace_in(&text, "#x6800000C\">", "<RxPdo ", "<RxPdo OSFac=\"65535\" "),
        says: says(
            "error",
            At::First("<RxPdo OSFac"),
            "Device[1]/Pdo",
            "65535 samples of PDO 0x1600",
        ),
    },
    Mutation {
        name: "a SyncManager without an address",
        damage: |text| replace(&text, r##" StartAddress="#x1060""##, ""),
        says: says(
            "refused",
            At::Nth(3, "<Sm "),
            "EtherCATInfo/Descriptions/Devices/Device[1]/Sm[3]",
            "StartAddress is missing",
        ),
    },
    Mutation {
        name: "a SyncManager beyond the memory",
        damage: |text| {
            replace(
                &text,
                r##"StartAddress="#x1060""##,
                r##"StartAddress="#xfff0""##,
            )
        },
        says: says(
            "error",
            At::Nth(3, "<Sm "),
            "Device[1]/Sm",
            "does not lie in a SubDevice's memory",
        ),
    },
    Mutation {
        name: "a SyncManager at the registers",
        damage: |text| {
            replace(
                &text,
                r##"StartAddress="#x1060""##,
                r##"StartAddress="#x0120""##,
            )
        },
        says: says(
            "error",
            At::Nth(3, "<Sm "),
            "Device[1]/Sm",
            "does not lie in a SubDevice's memory",
        ),
    },
    Mutation {
        name: "SyncManagers that overlap",
        damage: |text| {
            replace(
                &text,
                r##"StartAddress="#x10f0""##,
                r##"StartAddress="#x1062""##,
            )
        },
        says: says(
            "error",
            At::First("<Device "),
            "Device[1]",
            "reaches into SyncManager 3",
        ),
    },
    Mutation {
        name: "no mailbox SyncManager",
        damage: |text| replace(&text, ">MBoxIn<", ">Inputs<"),
        says: says(
            "warning",
            At::First("<Device "),
            "Device[1]",
            "no Sm for both of its directions",
        ),
    },
    Mutation {
        name: "an FMMU of a SyncManager that is not there",
        damage: |text| replace(&text, "<Fmmu>Inputs", r##"<Fmmu Sm="200">Inputs"##),
        says: says(
            "warning",
            At::First("<Device "),
            "Device[1]/Fmmu[2]",
            "Sm 200, which does not exist",
        ),
    },
    Mutation {
        name: "a slot of an unknown module",
        damage: |text| {
            replace(
                &text,
                r##"<ModuleIdent Default="1">#x6800000C"##,
                r##"<ModuleIdent Default="1">#xDEADBEEF"##,
            )
        },
        says: says(
            "error",
            At::First("<Slot "),
            "Device[1]/Slot",
            "module 0xdeadbeef, which neither",
        ),
    },
    Mutation {
        name: "a module without an identity",
        damage: |text| replace(&text, r##"<Type ModuleIdent="#x6300000C">"##, "<Type>"),
        says: says(
            "refused",
            At::Nth(2, "<Module>"),
            "EtherCATInfo/Descriptions/Modules/Module[2]",
            "ModuleIdent is missing",
        ),
    },
    Mutation {
        name: "a doubled module",
        damage: |text| {
            replace(
                &text,
                r##"<Type ModuleIdent="#x6300000C">"##,
                r##"<Type ModuleIdent="#x6100000C">"##,
            )
        },
        says: says(
            "warning",
            At::Nth(2, "<Module>"),
            "Module[2]",
            "described twice; the one on line 8271 is taken",
        ),
    },
    Mutation {
        name: "65535 instances of a slot",
        damage: |text| instances(&text, "65535"),
        says: says(
            "warning",
            At::First("<Slots "),
            "Device[1]/Slots",
            "65535 places for modules; 0xF030 lists 254",
        ),
    },
    Mutation {
        name: "4294967296 instances of a slot",
        damage: |text| instances(&text, "4294967296"),
        says: says(
            "refused",
            At::First("<Slot "),
            "EtherCATInfo/Descriptions/Devices/Device[1]/Slots/Slot[1]",
            r##"MinInstances "4294967296""##,
        ),
    },
    Mutation {
        name: "254 slots of large dictionaries",
        damage: |text| slots(&large_module(&text), 254),
        says: says(
            "error",
            At::First("<Slots "),
            "Device[1]/Slots",
            "in the 254 places of",
        ),
    },
    Mutation {
        name: "100000 slots",
        damage: |text| slots(&text, 100_000),
        says: says(
            "warning",
            At::First("<Slots "),
            "Device[1]/Slots",
            "100001 places for modules",
        ),
    },
    Mutation {
        name: "65535 instances of large dictionaries",
        damage: |text| instances(&large_module(&text), "65535"),
        says: says(
            "error",
            At::First("<Slots "),
            "Device[1]/Slots",
            "in the 254 places of",
        ),
    },
    Mutation {
        name: "an absurd increment",
        damage: |text| {
            replace(
                &text,
                r##"SlotPdoIncrement="1""##,
                r##"SlotPdoIncrement="#x10000""##,
            )
        },
        says: says(
            "refused",
            At::First("<Slots "),
            "EtherCATInfo/Descriptions/Devices/Device[1]/Slots",
            r##"SlotPdoIncrement "#x10000""##,
        ),
    },
    Mutation {
        name: "InitCmd data that is no data",
        damage: |text| replace_in(&text, "<InitCmd>", "<Data>01", "<Data>0x1"),
        says: says(
            "refused",
            At::First("<Data>0x1"),
            "EtherCATInfo/Descriptions/Modules/Module[1]/Mailbox/CoE/InitCmd[1]/Data",
            "not a sequence of hexadecimal bytes",
        ),
    },
    Mutation {
        name: "an object of 4294967295 bits",
        damage: |text| {
            replace(
                &text,
                "<Objects>",
                "<Objects><Object><Index>#x4000</Index><Type>HUGE</Type><BitSize>4294967295</BitSize></Object>",
            )
        },
        says: says(
            "refused",
            At::First("<Object><Index>#x4000"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/Profile/Dictionary",
            "an object's bits exceed 8388608",
        ),
    },
    Mutation {
        name: "1000 objects of a megabyte",
        damage: |text| {
            insert(&text, "<Object>", &"<Object><Index>#x4000</Index><Type>HUGE</Type><BitSize>8388608</BitSize></Object>".repeat(1000))
        },
        says: says(
            "refused",
            At::Nth(32, "<Object><Index>#x4000"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/Profile/Dictionary",
            "the objects' bytes exceed 33554432",
        ),
    },
    Mutation {
        name: "a doubled object",
        damage: |text| {
            insert(
                &text,
                "<Object>",
                "<Object><Index>#x1000</Index><Type>UDINT</Type><BitSize>32</BitSize></Object>",
            )
        },
        says: says(
            "warning",
            At::Nth(2, "<Object>"),
            "Device[1]/Object[2]",
            "object 0x1000 is described twice",
        ),
    },
    Mutation {
        name: "an array of 4294967295 elements",
        damage: |text| {
            replace(
                &text,
                "<LBound>1</LBound>\n                  <Elements>4<",
                "<LBound>1</LBound>\n                  <Elements>4294967295<",
            )
        },
        says: says(
            "warning",
            At::Before("<Index>#x1C00</Index>", "<Object>"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/Profile/Dictionary",
            "an array of 4294967295 elements; there are 255 subindices",
        ),
    },
    Mutation {
        name: "an array of 4294967296 elements",
        damage: |text| replace(&text, "<Elements>16<", "<Elements>4294967296<"),
        says: says(
            "refused",
            At::First("<Elements>"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/Profile/Dictionary/DataTypes/DataType[7]/ArrayInfo/Elements",
            r##"Elements "4294967296""##,
        ),
    },
    Mutation {
        name: "data types made of each other",
        damage: |text| {
            insert(
                &text,
                "<DataType>",
                "<DataType><Name>ROUND</Name><BaseType>ABOUT</BaseType></DataType><DataType><Name>ABOUT</Name><BaseType>ROUND</BaseType></DataType>",
            )
        },
        says: says(
            "warning",
            At::First("<DataType><Name>ABOUT"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/Profile/Dictionary/DataTypes",
            r##"type "ABOUT" is made of itself"##,
        ),
    },
    Mutation {
        name: "a type name of 2 MB in an array",
        damage: |text| long_type(&text),
        says: says(
            "refused",
            At::First("<Object><Index>#x4000"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/Profile/Dictionary",
            "the objects' bytes exceed 33554432",
        ),
    },
    Mutation {
        name: "a product code that is no number",
        damage: |text| {
            replace(
                &text,
                r##"ProductCode="#x69500000""##,
                r##"ProductCode="#x6950000G""##,
            )
        },
        says: says(
            "refused",
            At::First("<Type ProductCode"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/Type",
            r##"ProductCode "#x6950000G""##,
        ),
    },
    Mutation {
        name: "a vendor id of a million digits",
        damage: |text| replace(&text, "#x000000FB", &"9".repeat(1_000_000)),
        says: says(
            "refused",
            At::First("<Id>"),
            "EtherCATInfo/Vendor/Id",
            r##"vendor id "99999999"##,
        ),
    },
    Mutation {
        name: "a cycle beyond 64 bits",
        damage: |text| {
            replace_in(
                &text,
                "<OpMode>",
                "<CycleTimeSync0 Factor=\"1\">0",
                "<CycleTimeSync0 Factor=\"1\">99999999999999999999",
            )
        },
        says: says(
            "refused",
            At::First("<CycleTimeSync0"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/Dc/OpMode[1]/CycleTimeSync0",
            "time in nanoseconds",
        ),
    },
    Mutation {
        name: "a cycle beyond its register",
        damage: |text| {
            replace_in(
                &text,
                "<OpMode>",
                "<CycleTimeSync0 Factor=\"1\">0",
                "<CycleTimeSync0 Factor=\"1\">4294967296",
            )
        },
        says: says(
            "error",
            At::First("<Device "),
            "Device[1]",
            "a SYNC0 cycle that does not fit",
        ),
    },
    Mutation {
        name: "a doubled device",
        damage: |text| doubled(&text, 1),
        says: says(
            "warning",
            At::Nth(2, "<Device "),
            "Device[2]",
            "described twice, first on line 18",
        ),
    },
    Mutation {
        name: "5000 doubled devices with 254 places each",
        damage: |text| doubled(&text, 5000),
        says: says(
            "warning",
            At::Last("<Device "),
            "Devices",
            "not all layouts were tried",
        ),
    },
    Mutation {
        name: "a device without a type",
        damage: |text| {
            replace(
                &text,
                r##"<Type ProductCode="#x69500000" RevisionNo="#x01700000">EPOS4</Type>"##,
                "",
            )
        },
        says: says(
            "refused",
            At::First("<Device "),
            "EtherCATInfo/Descriptions/Devices/Device[1]",
            "Device/Type is missing",
        ),
    },
    Mutation {
        name: "entities that multiply",
        damage: |text| bomb(&text),
        says: says(
            "warning",
            At::First("<Name>EPOS4 Micro"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/Name",
            "entity &lol9; is not expanded",
        ),
    },
    Mutation {
        name: "an unknown entity in an attribute",
        damage: |text| replace(&text, r##"Physics="YY""##, r##"Physics="&lol;""##),
        says: says(
            "refused",
            At::First("<Device "),
            "EtherCATInfo/Descriptions/Devices/Device[1]",
            "attribute Physics",
        ),
    },
    Mutation {
        name: "100 levels deep",
        damage: |text| {
            insert(
                &text,
                "<GroupType>",
                &(0..100).map(|n| format!("<level{n}>")).collect::<String>(),
            )
        },
        says: says(
            "refused",
            At::First("<level59>"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/level0/level1/level2/level3/level4/level5/level6/level7/level8/level9/level10/level11/level12/level13/level14/level15/level16/level17/level18/level19/level20/level21/level22/level23/level24/level25/level26/level27/level28/level29/level30/level31/level32/level33/level34/level35/level36/level37/level38/level39/level40/level41/level42/level43/level44/level45/level46/level47/level48/level49/level50/level51/level52/level53/level54/level55/level56/level57/level58/level59",
            "nested deeper than 64",
        ),
    },
    Mutation {
        name: "a wrong encoding label",
        damage: |text| {
            replace(
                &text,
                r##"encoding="iso-8859-1""##,
                r##"encoding="klingon-8""##,
            )
        },
        says: says(
            "warning",
            At::First("<?xml"),
            "EtherCATInfo",
            "encoding \"klingon-8\" is not supported",
        ),
    },
    Mutation {
        name: "UTF-16 on the label alone",
        damage: |text| {
            replace(
                &text,
                r##"encoding="iso-8859-1""##,
                r##"encoding="UTF-16""##,
            )
        },
        says: says(
            "warning",
            At::First("<?xml"),
            "EtherCATInfo",
            "encoding \"utf-16\" is not supported",
        ),
    },
    Mutation {
        name: "UTF-8 on the label alone",
        damage: |text| {
            replace(&text, "encoding=\"iso-8859-1\"", "encoding=\"utf-8\"")
                .replace("<Name>EPOS4 Micro", "<Name>\u{b5}POS4")
        },
        says: says(
            "warning",
            At::First("\u{b5}POS4"),
            "EtherCATInfo",
            "is not UTF-8",
        ),
    },
    Mutation {
        name: "a NUL in a name",
        damage: |text| replace(&text, "<Name>EPOS4 Micro", "<Name>EPOS4\0Micro"),
        says: says(
            "warning",
            At::First("\0Micro"),
            "EtherCATInfo",
            "a NUL character",
        ),
    },
    Mutation {
        name: "200000 element names",
        damage: |text| {
            insert(
                &text,
                "<GroupType>",
                &(0..200_000).map(|n| format!("<e{n}/>")).collect::<String>(),
            )
            .replace("#x69500000", "#x")
        },
        says: says(
            "refused",
            At::First("<Type ProductCode"),
            "EtherCATInfo/Descriptions/Devices/Device[1]/Type",
            "ProductCode \"#x\"",
        ),
    },
];

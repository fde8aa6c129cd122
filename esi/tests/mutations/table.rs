//! The damages with their expected messages.

pub struct Mutation {
    pub name: &'static str,
    pub damage: fn(String) -> String,
    pub says: Says,
}

pub struct Says {
    /// `refused`: the whole file is unreadable; otherwise the severity of a finding.
    pub kind: &'static str,
    pub at: At,
    pub path: &'static str,
    /// A part of the message.
    pub text: &'static str,
}

/// A position in the damaged text.
pub enum At {
    First(&'static str),
    /// The n-th occurrence, from 1.
    Nth(usize, &'static str),
    Last(&'static str),
    /// The last occurrence of the second text before the first occurrence of the first text.
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

pub fn replace(text: &str, from: &str, to: &str) -> String {
    assert!(text.contains(from), "{from}");
    text.replacen(from, to, 1)
}

/// Replaces the first `from` after `behind`.
pub fn replace_in(text: &str, behind: &str, from: &str, to: &str) -> String {
    let (before, after) = text.split_once(behind).unwrap();
    format!("{before}{behind}{}", replace(after, from, to))
}

pub fn insert(text: &str, before: &str, new: &str) -> String {
    replace(text, before, &format!("{new}{before}"))
}

pub fn cut(mut text: String, at: &str) -> String {
    text.truncate(text.rfind(at).unwrap());
    text
}

pub fn cut_first(mut text: String, at: &str) -> String {
    text.truncate(text.find(at).unwrap());
    text
}

/// Adds `count` objects of 10 kB to the default module, and other objects to each slot.
pub fn large_module(text: &str, count: usize) -> String {
    let objects: String = (0..count)
        .map(|n| {
            let index = format!("<Index DependOnSlot=\"1\">#x{:x}</Index>", 0x8000 + n);
            format!("<Object>{index}<Type>BIG</Type><BitSize>80000</BitSize></Object>")
        })
        .collect();
    let text = replace(
        text,
        "SlotIndexIncrement=\"0\"",
        "SlotIndexIncrement=\"16\"",
    );
    let all = format!("<Objects>{objects}");
    replace_in(&text, "ModuleIdent=\"#x6800000C\">", "<Objects>", &all)
}

pub fn instances(text: &str, count: &str) -> String {
    let text = replace(text, "MaxSlotCount=\"1\" ", "");
    let both = format!("<Slot MinInstances=\"{count}\" MaxInstances=\"{count}\"");
    replace(&text, "<Slot MinInstances=\"1\" MaxInstances=\"1\"", &both)
}

pub fn slots(text: &str, count: usize) -> String {
    let text = replace(text, "MaxSlotCount=\"1\" ", "");
    let slot =
        "<Slot MinInstances=\"1\"><Name>S</Name><ModuleIdent>#x6800000C</ModuleIdent></Slot>";
    insert(&text, "</Slots>", &slot.repeat(count))
}

/// Adds `count` small copies of the device, each with enough places.
pub fn doubled(text: &str, count: usize) -> String {
    let device = "<Device Physics=\"YY\"><Type ProductCode=\"#x69500000\" RevisionNo=\"#x01700000\">E</Type>\
                  <Slots><Slot MinInstances=\"254\" MaxInstances=\"254\"><ModuleIdent>1</ModuleIdent></Slot></Slots></Device>";
    let module = "<Module><Type ModuleIdent=\"1\">M</Type></Module>";
    let text = insert(text, "</Devices>", &device.repeat(count));
    insert(&text, "</Modules>", module)
}

pub fn long_type(text: &str) -> String {
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

/// Nests entities with ten references per level.
pub fn bomb(text: &str) -> String {
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

pub const fn row(
    name: &'static str,
    damage: fn(String) -> String,
    (kind, at): (&'static str, At),
    path: &'static str,
    text: &'static str,
) -> Mutation {
    let says = Says {
        kind,
        at,
        path,
        text,
    };
    Mutation { name, damage, says }
}

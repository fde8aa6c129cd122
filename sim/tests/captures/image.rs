//! EEPROM images and objects from a capture.

use std::collections::BTreeMap;

use ecaxis_esi::model::{Access, Writable};
use ecaxis_esi::sii;
use ecaxis_sim::SimDevice;

use super::recording::{FPRD, FPWR, Recording};

const EEPROM_CONTROL: u16 = 0x0502;
const EEPROM_DATA: u16 = 0x0508;
const HEADER: usize = 0x80;
const SIZE: usize = 2048;

/// Returns the EEPROM bytes of a device that the capture contains, by byte address.
pub fn recorded_bytes(recording: &Recording, station: u16) -> BTreeMap<usize, u8> {
    let mut word = 0;
    let mut known = BTreeMap::new();
    for (_, _, back) in recording.answered() {
        if back.adp != station || back.wkc == 0 {
            continue;
        }
        match (back.command, back.ado, back.data.as_slice()) {
            (FPWR, EEPROM_CONTROL, [_, _, low, high, ..]) => {
                word = usize::from(u16::from_le_bytes([*low, *high]));
            }
            (FPRD, EEPROM_DATA, data) => {
                known.extend((word * 2..).zip(data.iter().copied()));
            }
            _ => {}
        }
    }
    known
}

/// Returns an image of the recorded bytes. No MainDevice reads the first seven words: the PDI
/// control word is given, the others are 0, and the checksum is correct. Missing bytes are 0 in the
/// header and 0xff in the categories.
pub fn recorded_image(known: &BTreeMap<usize, u8>, pdi_control: u16, pdos: &Pdos) -> Vec<u8> {
    let end = known.keys().next_back().map_or(HEADER, |last| last + 1);
    let mut image = vec![0; HEADER];
    image.resize(SIZE.max(end.next_multiple_of(2)), 0xff);
    for (at, byte) in known {
        image[*at] = *byte;
    }
    image[..2].copy_from_slice(&pdi_control.to_le_bytes());
    let config: [u8; 14] = image[..14].try_into().unwrap();
    image[14] = sii::checksum(&config);
    pdos.append_to(&mut image);
    image
}

/// A device's objects, as mailbox traffic shows them.
#[derive(Debug, Default)]
pub struct Objects {
    /// (index, sub) → data of the first upload, and whether it used complete access.
    uploads: BTreeMap<(u16, u8), (Vec<u8>, bool)>,
    /// (index, sub) → data of a download before any upload.
    downloads: BTreeMap<(u16, u8), Vec<u8>>,
}

impl Objects {
    pub fn recorded(recording: &Recording, station: u16) -> Self {
        let mut objects = Self::default();
        for (_, sent, back) in recording.answered() {
            if back.adp != station || back.wkc == 0 || back.ado < 0x1000 {
                continue;
            }
            match back.command {
                FPWR => objects.request(&sent.data),
                FPRD => objects.reply(&back.data),
                _ => {}
            }
        }
        objects
    }

    /// Records an SDO download request. All requests in these captures are expedited.
    fn request(&mut self, message: &[u8]) {
        if let Some((command, key, data)) = sdo(message, 2)
            && command >> 5 == 1
        {
            self.downloads.insert(key, data);
        }
    }

    fn reply(&mut self, message: &[u8]) {
        if let Some((command, key, data)) = sdo(message, 3)
            && command >> 5 == 2
            && !self.downloads.contains_key(&key)
        {
            let complete = command & 0x10 != 0;
            self.uploads.entry(key).or_insert((data, complete));
        }
    }

    /// Adds objects that the image does not contain to a device's dictionary. Read objects get
    /// their value; written objects are writable and 0.
    pub fn feed(&self, device: &mut SimDevice) {
        let mut add = |(index, sub): (u16, u8), write, value: &[u8]| {
            device.add_object(index, sub, Access { read: true, write }, value);
        };
        for (key, data) in &self.downloads {
            add(*key, Writable::Always, &vec![0; data.len()]);
        }
        for (key, (data, complete)) in &self.uploads {
            if !complete {
                add(*key, Writable::Never, data);
            }
        }
    }
}

/// Returns command byte, object and data of an SDO message in a mailbox: expedited or normal.
fn sdo(message: &[u8], service: u8) -> Option<(u8, (u16, u8), Vec<u8>)> {
    let len = usize::from(u16::from_le_bytes([*message.first()?, *message.get(1)?]));
    let body = message.get(6..6 + len)?;
    if message.get(5)? & 0x0f != 3 || body.get(1)? >> 4 != service {
        return None;
    }
    let [command, low, high, sub, a, b, c, d] = *body.get(2..10)?.first_chunk()?;
    let key = (u16::from_le_bytes([low, high]), sub);
    let data = if command & 2 != 0 {
        let unused = if command & 1 != 0 {
            command >> 2 & 3
        } else {
            0
        };
        [a, b, c, d][..4 - usize::from(unused)].to_vec()
    } else {
        let size = u32::from_le_bytes([a, b, c, d]);
        body.get(10..10 + usize::try_from(size).ok()?)?.to_vec()
    };
    Some((command, key, data))
}

/// PDO categories that the capture's MainDevice read over CoE instead of from the EEPROM.
#[derive(Debug, Default)]
pub struct Pdos(Vec<(u16, u8, Vec<u32>)>);

impl Pdos {
    /// Returns assignment and mapping as read by complete access. Assigned PDOs without a recorded
    /// mapping get one 16-bit value.
    pub fn recorded(objects: &Objects) -> Self {
        let mut pdos = Self::default();
        for (index, sm) in [(0x1c12_u16, 2), (0x1c13, 3)] {
            let read = objects.uploads.get(&(index, 0)).map(|(data, _)| data);
            let assigned: Vec<u16> = match read.filter(|data| data.len() > 1) {
                Some(list) => words(list).collect(),
                None => {
                    let written = objects.downloads.range((index, 1)..=(index, u8::MAX));
                    written.flat_map(|(_, data)| words_of(data)).collect()
                }
            };
            for pdo in assigned {
                let mapping = objects.uploads.get(&(pdo, 0));
                let entries = match mapping {
                    Some((list, true)) => double_words(list),
                    _ => vec![u32::from(pdo ^ 0x7a00) << 16 | 0x1110],
                };
                pdos.0.push((pdo, sm, entries));
            }
        }
        pdos
    }

    /// Inserts the categories before the end mark.
    fn append_to(&self, image: &mut [u8]) {
        if self.0.is_empty() {
            return;
        }
        let mut at = HEADER;
        while image[at..at + 2] != [0xff, 0xff] {
            at += 4 + usize::from(u16::from_le_bytes([image[at + 2], image[at + 3]])) * 2;
        }
        for (kind, of_kind) in [(50_u16, 0x1a00_u16), (51, 0x1600)] {
            let mut data = Vec::new();
            for (index, sm, entries) in self.0.iter().filter(|(i, ..)| i & 0xff00 == of_kind) {
                data.extend(index.to_le_bytes());
                data.extend([u8::try_from(entries.len()).unwrap(), *sm, 0, 0, 0, 0]);
                for entry in entries {
                    let [bits, sub, low, high] = entry.to_le_bytes();
                    data.extend([low, high, sub, 0, 0, bits, 0, 0]);
                }
            }
            let words = u16::try_from(data.len() / 2).unwrap();
            let category = [kind.to_le_bytes(), words.to_le_bytes()].concat();
            for byte in category.into_iter().chain(data).filter(|_| words > 0) {
                image[at] = byte;
                at += 1;
            }
        }
    }
}

fn words_of(data: &[u8]) -> impl Iterator<Item = u16> + '_ {
    data.chunks_exact(2)
        .map(|pair| u16::from_le_bytes([pair[0], pair[1]]))
}

/// Returns the elements after subindex 0, which takes 16 bits.
fn words(list: &[u8]) -> impl Iterator<Item = u16> + '_ {
    words_of(list).skip(1)
}

fn double_words(list: &[u8]) -> Vec<u32> {
    let elements = list.get(2..).unwrap_or_default().chunks_exact(4);
    let element = |bytes: &[u8]| u32::from_le_bytes(bytes.try_into().unwrap());
    elements.map(element).collect()
}

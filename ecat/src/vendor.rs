//! Vendor ids of the ETG with the names of their owners.

use core::fmt;

/// Common vendors of drives and I/O devices, with the names in their ESI files.
const VENDORS: [(u32, &str); 9] = [
    (0x0000_0002, "Beckhoff Automation"),
    (0x0000_0044, "Hilscher"),
    (0x0000_009a, "Elmo Motion Control"),
    (0x0000_00fb, "maxon motor"),
    (0x0000_01f9, "National Instruments"),
    (0x0000_059d, "Texas Instruments"),
    (0x0000_22d2, "Synapticon"),
    (0x0010_0000, "Inovance"),
    (0x0040_0000, "STEPPERONLINE"),
];

/// Returns the name of a vendor, if the table has it. ESI files name further ones.
#[must_use]
pub fn vendor_name(id: u32) -> Option<&'static str> {
    let found = VENDORS.iter().find(|(known, _)| *known == id)?;
    Some(found.1)
}

/// A vendor id, formatted in hexadecimal with its name if it is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VendorId(pub u32);

impl fmt::Display for VendorId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "0x{:08x}", self.0)?;
        match vendor_name(self.0) {
            Some(name) => write!(f, " ({name})"),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_vendors_have_their_name() {
        assert_eq!(VendorId(2).to_string(), "0x00000002 (Beckhoff Automation)");
        assert_eq!(VendorId(0x1234).to_string(), "0x00001234");
        assert!(VENDORS.is_sorted());
    }
}

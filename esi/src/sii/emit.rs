//! Image contents → bytes.

use super::strings::Table;
use super::{HEADER_BYTES, Sii, SiiPdo, category, fmmu_code, sm_code};

/// Vendors set unused bits to 1.
const UNUSED_FMMU_FLAGS: u8 = 0xf8;
const UNUSED_UNIT_FLAGS: u8 = 0xf0;

impl Sii {
    /// Returns the image, padded with 0xff to `byte_size`. Longer contents extend the image in
    /// steps of 128 bytes.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let categories = self.categories();
        let needed = HEADER_BYTES + categories.len();
        let size = needed
            .max(usize::try_from(self.byte_size).unwrap_or(0))
            .next_multiple_of(128);
        let mut out = self.header(size);
        out.extend_from_slice(&categories);
        out.resize(size, 0xff);
        out
    }

    fn header(&self, size: usize) -> Vec<u8> {
        let mut config = self.config;
        if let Some(field) = config.get_mut(8..10) {
            field.copy_from_slice(&self.alias.to_le_bytes());
        }
        let mut out = config.to_vec();
        out.extend_from_slice(&[checksum(&config), 0]);
        for word in [
            self.identity.vendor,
            self.identity.product,
            self.identity.revision,
            self.serial,
        ] {
            out.extend_from_slice(&word.to_le_bytes());
        }
        out.resize(0x28, 0);
        for areas in [self.bootstrap, self.mailbox] {
            for word in [
                areas.receive_offset,
                areas.receive_size,
                areas.send_offset,
                areas.send_size,
            ] {
                out.extend_from_slice(&word.to_le_bytes());
            }
        }
        out.extend_from_slice(&self.protocols.0.to_le_bytes());
        out.resize(0x7c, 0);
        let kibit = u16::try_from(size / 128)
            .unwrap_or(u16::MAX)
            .saturating_sub(1);
        out.extend_from_slice(&kibit.to_le_bytes());
        out.extend_from_slice(&1u16.to_le_bytes());
        out
    }

    fn categories(&self) -> Vec<u8> {
        let mut strings = Table::default();
        // The string category comes first in the image, but its contents are complete only at the
        // end.
        let mut rest = Vec::new();
        if let Some(data) = self.general_category(&mut strings) {
            push(&mut rest, category::GENERAL, &data, 0);
        }
        if !self.fmmus.is_empty() {
            let data: Vec<u8> = self.fmmus.iter().map(|usage| fmmu_code(*usage)).collect();
            push(&mut rest, category::FMMU, &data, 0xff);
        }
        if !self.sync_managers.is_empty() {
            let mut data = Vec::new();
            for sm in &self.sync_managers {
                data.extend_from_slice(&sm.start_address.to_le_bytes());
                data.extend_from_slice(&sm.len.to_le_bytes());
                data.extend_from_slice(&[sm.control, 0, sm.enable, sm_code(sm.usage)]);
            }
            push(&mut rest, category::SYNC_MANAGER, &data, 0);
        }
        if !self.fmmu_details.is_empty() {
            let data = self.fmmu_details.iter().flat_map(|detail| {
                let flags = [
                    (detail.op_only, 1),
                    (detail.sm.is_some(), 2),
                    (detail.su.is_some(), 4),
                ];
                let flags: u8 = flags.iter().filter(|(on, _)| *on).map(|(_, bit)| bit).sum();
                let (sm, su) = (detail.sm.unwrap_or(0), detail.su.unwrap_or(0));
                [UNUSED_FMMU_FLAGS | flags, 0xff, sm, su]
            });
            push(
                &mut rest,
                category::FMMU_DETAILS,
                &data.collect::<Vec<u8>>(),
                0,
            );
        }
        if !self.sync_units.is_empty() {
            let data = self
                .sync_units
                .iter()
                .flat_map(|flags| [UNUSED_UNIT_FLAGS | flags, 0xff]);
            push(
                &mut rest,
                category::SYNC_UNIT,
                &data.collect::<Vec<u8>>(),
                0,
            );
        }
        for (kind, pdos) in [
            (category::TX_PDO, &self.tx_pdos),
            (category::RX_PDO, &self.rx_pdos),
        ] {
            if !pdos.is_empty() {
                push(&mut rest, kind, &pdo_category(pdos, &mut strings), 0);
            }
        }
        if !self.dc.is_empty() {
            push(&mut rest, category::DC, &self.dc_category(&mut strings), 0);
        }
        let mut out = Vec::new();
        push(&mut out, category::STRINGS, &strings.to_bytes(), 0);
        out.append(&mut rest);
        for (kind, data) in &self.others {
            push(&mut out, *kind, data, 0);
        }
        out.extend_from_slice(&category::END.to_le_bytes());
        out
    }

    fn general_category(&self, strings: &mut Table) -> Option<Vec<u8>> {
        let general = self.general.as_ref()?;
        let order = strings.number(&general.order);
        let group = strings.number(&general.group);
        let image = strings.number(&general.image);
        let name = strings.number(&general.name);
        let mut data = vec![group, image, order, name, 0, general.coe_details];
        data.extend_from_slice(&[
            u8::from(general.foe),
            u8::from(general.eoe),
            0,
            0,
            0,
            general.flags,
        ]);
        data.extend_from_slice(&general.ebus_ma.to_le_bytes());
        data.extend_from_slice(&[group, 0]);
        data.extend_from_slice(&general.ports.to_le_bytes());
        data.extend_from_slice(&general.identification_address.to_le_bytes());
        data.resize(32, 0);
        Some(data)
    }

    fn dc_category(&self, strings: &mut Table) -> Vec<u8> {
        let mut data = Vec::new();
        for mode in &self.dc {
            data.extend_from_slice(&mode.cycle0_ns.to_le_bytes());
            data.extend_from_slice(&mode.shift0_ns.to_le_bytes());
            data.extend_from_slice(&mode.shift1_ns.to_le_bytes());
            data.extend_from_slice(&mode.sync1_factor.to_le_bytes());
            data.extend_from_slice(&mode.assign_activate.to_le_bytes());
            data.extend_from_slice(&mode.sync0_factor.to_le_bytes());
            data.extend_from_slice(&[
                strings.number(&mode.name),
                strings.number(&mode.description),
            ]);
            data.extend_from_slice(&[0; 4]);
        }
        data
    }
}

fn pdo_category(pdos: &[SiiPdo], strings: &mut Table) -> Vec<u8> {
    let mut data = Vec::new();
    for pdo in pdos {
        let count = u8::try_from(pdo.entries.len()).unwrap_or(u8::MAX);
        data.extend_from_slice(&pdo.index.to_le_bytes());
        data.extend_from_slice(&[
            count,
            pdo.sm.unwrap_or(0xff),
            pdo.synchronization,
            strings.number(&pdo.name),
        ]);
        data.extend_from_slice(&pdo.flags.to_le_bytes());
        for entry in pdo.entries.iter().take(usize::from(count)) {
            data.extend_from_slice(&entry.index.to_le_bytes());
            data.extend_from_slice(&[
                entry.sub,
                strings.number(&entry.name),
                entry.data_type,
                entry.bit_len,
            ]);
            data.extend_from_slice(&entry.flags.to_le_bytes());
        }
    }
    data
}

fn push(out: &mut Vec<u8>, kind: u16, data: &[u8], pad: u8) {
    let words = u16::try_from(data.len().div_ceil(2)).unwrap_or(u16::MAX);
    out.extend_from_slice(&kind.to_le_bytes());
    out.extend_from_slice(&words.to_le_bytes());
    out.extend(data.iter().copied().take(usize::from(words) * 2));
    if !data.len().is_multiple_of(2) {
        out.push(pad);
    }
}

/// Returns the checksum of the first 14 bytes of an image, which byte 14 contains:
/// CRC-8, polynomial x⁸+x²+x+1, start value 0xff, no reflection (ETG.2010).
#[must_use]
pub fn checksum(config: &[u8; 14]) -> u8 {
    config.iter().fold(0xff, |crc, &byte| {
        (0..8).fold(crc ^ byte, |crc: u8, _| {
            if crc & 0x80 != 0 {
                crc << 1 ^ 0x07
            } else {
                crc << 1
            }
        })
    })
}

#[cfg(test)]
mod tests {
    use super::checksum;

    /// Controller settings and checksums from real devices.
    #[test]
    fn checksum_matches_real_devices() {
        for (config, expected) in [
            ([0x04, 0x01, 0, 0, 0, 0, 0x0f, 0, 0, 0, 0, 0, 0, 0], 0xd8),
            ([0, 0x0d, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], 0x46),
            ([0x08, 0, 0, 0x66, 0, 0x01, 0, 0, 0, 0, 0, 0, 0, 0], 0x0a),
        ] {
            assert_eq!(checksum(&config), expected);
        }
    }
}

//! What only the network driver and the kernel's network stack know.

use std::ffi::CStr;

use crate::os::ethtool::{Driver, Question, WORDS};
use crate::os::packet;

/// `ETH_FLAG_…` of the flags.
const FLAG_RX_VLAN: u32 = 1 << 8;
const FLAG_LRO: u32 = 1 << 15;

/// `None`: the driver does not say.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Answers {
    pub driver: Option<String>,
    pub coalescing: Option<Coalescing>,
    pub energy_efficient: Option<EnergyEfficient>,
    /// Generic and large receive offload, VLAN tags taken off.
    pub gro: Option<bool>,
    pub lro: Option<bool>,
    pub rx_vlan: Option<bool>,
    /// Receive descriptors: in use, at most.
    pub ring: Option<(u32, u32)>,
    /// Receive queues.
    pub queues: Option<u32>,
    /// IP addresses on it.
    pub addresses: Vec<String>,
}

/// How long the card saves up frames before it interrupts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Coalescing {
    pub rx_us: u32,
    /// Adapted to the traffic by the driver.
    pub adaptive_rx: bool,
}

/// IEEE 802.3az.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EnergyEfficient {
    pub enabled: bool,
    /// The device at the other end takes part.
    pub active: bool,
}

/// Asks about an interface of this computer.
#[must_use]
pub fn ask(nic: &str) -> Answers {
    let addresses = packet::ip_addresses(nic).unwrap_or_default();
    let mut answers = Answers {
        addresses: addresses.iter().map(ToString::to_string).collect(),
        ..Answers::default()
    };
    let Ok(driver) = Driver::of(nic) else {
        return answers;
    };
    let ask = |question| driver.ask(question).ok();
    answers.driver = ask(Question::DriverInfo).and_then(|a| name(&a));
    answers.coalescing = ask(Question::Coalescing).map(|a| Coalescing {
        rx_us: a[1],
        adaptive_rx: a[10] != 0,
    });
    answers.energy_efficient = ask(Question::EnergyEfficient).map(|a| EnergyEfficient {
        active: a[4] != 0,
        enabled: a[5] != 0,
    });
    answers.gro = ask(Question::GenericReceiveOffload).map(|a| a[1] != 0);
    let flags = ask(Question::Flags).map(|a| a[1]);
    answers.lro = flags.map(|f| f & FLAG_LRO != 0);
    answers.rx_vlan = flags.map(|f| f & FLAG_RX_VLAN != 0);
    answers.ring = ask(Question::Ring).map(|a| (a[5], a[1]));
    // Those that receive alone, and those that send as well.
    answers.queues = ask(Question::Channels).map(|a| a[5].saturating_add(a[8]));
    answers
}

/// The second field, NUL-terminated in 32 bytes.
fn name(answer: &[u32; WORDS]) -> Option<String> {
    let bytes: Vec<u8> = answer[1..9]
        .iter()
        .flat_map(|word| word.to_ne_bytes())
        .collect();
    let name = CStr::from_bytes_until_nul(&bytes).ok()?.to_string_lossy();
    (!name.is_empty()).then(|| super::text::short(&name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_loopback_has_its_addresses() {
        let answers = ask("lo");
        assert!(
            answers.addresses.iter().any(|a| a == "127.0.0.1"),
            "{answers:?}"
        );
        assert_eq!(answers.energy_efficient, None);
    }

    #[test]
    fn no_such_interface() {
        for nic in [
            "nonet7",
            "",
            "a_name_that_is_much_too_long_for_an_interface",
        ] {
            assert_eq!(ask(nic), Answers::default(), "{nic}");
        }
    }

    #[test]
    fn a_drivers_name() {
        let mut answer = [0_u32; WORDS];
        answer[1] = u32::from_ne_bytes(*b"igc\0");
        assert_eq!(name(&answer).as_deref(), Some("igc"));
        assert_eq!(name(&[0; WORDS]), None);
        assert_eq!(name(&[u32::MAX; WORDS]), None);
    }
}

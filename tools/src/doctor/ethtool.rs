//! Settings known only to the network driver and the kernel's network stack.

use std::ffi::CStr;

use ecaxis_master::sys::ethtool::{EthtoolCommand, EthtoolSocket, WORDS};
use ecaxis_master::sys::packet;

/// The `ETH_FLAG_…` bits of the flags.
const FLAG_RX_VLAN: u32 = 1 << 8;
const FLAG_LRO: u32 = 1 << 15;

/// The driver's answers. `None`: the driver does not report it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Answers {
    pub driver: Option<String>,
    pub coalescing: Option<Coalescing>,
    pub energy_efficient: Option<EnergyEfficient>,
    /// Generic and large receive offload, VLAN tag stripping.
    pub gro: Option<bool>,
    pub lro: Option<bool>,
    pub rx_vlan: Option<bool>,
    /// Receive descriptors: current and maximum.
    pub ring: Option<(u32, u32)>,
    /// The number of receive queues.
    pub queues: Option<u32>,
    /// The IP addresses of the interface.
    pub addresses: Vec<String>,
}

/// Interrupt coalescing: how long the card collects frames before an interrupt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Coalescing {
    pub rx_us: u32,
    /// True if the driver adapts it to the traffic.
    pub adaptive_rx: bool,
}

/// Energy-Efficient Ethernet (IEEE 802.3az).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EnergyEfficient {
    pub enabled: bool,
    /// True if the link partner uses it as well.
    pub active: bool,
}

/// Queries an interface of this computer.
#[must_use]
pub fn ask(nic: &str) -> Answers {
    let addresses = packet::ip_addresses(nic).unwrap_or_default();
    let mut answers = Answers {
        addresses: addresses.iter().map(ToString::to_string).collect(),
        ..Answers::default()
    };
    let Ok(driver) = EthtoolSocket::of(nic) else {
        return answers;
    };
    let ask = |question| driver.ask(question).ok();
    answers.driver = ask(EthtoolCommand::DriverInfo).and_then(|a| name(&a));
    answers.coalescing = ask(EthtoolCommand::Coalescing).map(|a| Coalescing {
        rx_us: a[1],
        adaptive_rx: a[10] != 0,
    });
    answers.energy_efficient = ask(EthtoolCommand::EnergyEfficient).map(|a| EnergyEfficient {
        active: a[4] != 0,
        enabled: a[5] != 0,
    });
    answers.gro = ask(EthtoolCommand::GenericReceiveOffload).map(|a| a[1] != 0);
    let flags = ask(EthtoolCommand::Flags).map(|a| a[1]);
    answers.lro = flags.map(|f| f & FLAG_LRO != 0);
    answers.rx_vlan = flags.map(|f| f & FLAG_RX_VLAN != 0);
    answers.ring = ask(EthtoolCommand::Ring).map(|a| (a[5], a[1]));
    // Receive-only queues and combined queues.
    answers.queues = ask(EthtoolCommand::Channels).map(|a| a[5].saturating_add(a[8]));
    answers
}

/// Returns the second field: NUL-terminated in 32 bytes.
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
    fn ask_returns_the_loopback_addresses() {
        let answers = ask("lo");
        assert!(
            answers.addresses.iter().any(|a| a == "127.0.0.1"),
            "{answers:?}"
        );
        assert_eq!(answers.energy_efficient, None);
    }

    #[test]
    fn ask_returns_nothing_for_an_unknown_interface() {
        for nic in [
            "nonet7",
            "",
            "a_name_that_is_much_too_long_for_an_interface",
        ] {
            assert_eq!(ask(nic), Answers::default(), "{nic}");
        }
    }

    #[test]
    fn name_parses_the_driver_name() {
        let mut answer = [0_u32; WORDS];
        answer[1] = u32::from_ne_bytes(*b"igc\0");
        assert_eq!(name(&answer).as_deref(), Some("igc"));
        assert_eq!(name(&[0; WORDS]), None);
        assert_eq!(name(&[u32::MAX; WORDS]), None);
    }
}

//! The network interface that an option names, or both interfaces of a ring.

use std::str::FromStr;

use ecaxis_master::config::{Bus, Nic};

/// One network interface, or both ends of a ring: `enp3s0`, or `enp3s0,enp4s0`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct NicArg {
    pub first: String,
    /// The interface at the other end of a ring.
    pub second: Option<String>,
}

impl FromStr for NicArg {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (first, second) = match text.split_once(',') {
            None => (text, None),
            Some((first, second)) => (first, Some(second)),
        };
        let names = || std::iter::once(first).chain(second);
        if names().any(|name| name.is_empty() || name.contains(',')) {
            return Err("name one interface, or both ends of a ring as `IF,IF`".to_owned());
        }
        if second.is_some() && names().any(|name| name == "sim") {
            return Err("`sim` is the simulated bus, not an end of a ring of devices".to_owned());
        }
        if second == Some(first) {
            return Err(format!("both ends of the ring are `{first}`"));
        }
        Ok(Self {
            first: first.to_owned(),
            second: second.map(str::to_owned),
        })
    }
}

impl NicArg {
    pub fn is_sim(&self) -> bool {
        self.first == "sim"
    }

    /// Replaces the interfaces of a machine. One interface alone keeps the file's `redundant`.
    pub fn replace(&self, bus: &mut Bus) {
        if self.is_sim() {
            bus.nic = Nic::Sim;
            return;
        }
        bus.nic = Nic::Interface(self.first.clone());
        if self.second.is_some() {
            bus.redundant.clone_from(&self.second);
        } else if bus.redundant.as_ref() == Some(&self.first) {
            bus.redundant = None;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nic_arg_is_one_interface_or_a_ring() {
        let arg = "a".parse::<NicArg>().unwrap();
        assert_eq!((arg.first.as_str(), arg.second), ("a", None));
        let arg = "a,b".parse::<NicArg>().unwrap();
        assert_eq!(
            (arg.first.as_str(), arg.second.as_deref()),
            ("a", Some("b"))
        );
        for wrong in ["", "a,", ",b", "a,b,c", "a,a", "sim,b", "a,sim"] {
            assert!(wrong.parse::<NicArg>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn replace_sets_both_ends_and_keeps_the_second_one_of_the_file() {
        let replaced = |arg: &str, redundant: Option<&str>| {
            let mut bus = Bus {
                redundant: redundant.map(str::to_owned),
                ..Bus::default()
            };
            arg.parse::<NicArg>().unwrap().replace(&mut bus);
            (bus.nic, bus.redundant)
        };
        let interface = |name: &str| Nic::Interface(name.to_owned());
        let name = |name: &str| Some(name.to_owned());
        assert_eq!(replaced("a", None), (interface("a"), None));
        assert_eq!(replaced("a", Some("c")), (interface("a"), name("c")));
        assert_eq!(replaced("a", Some("a")), (interface("a"), None));
        assert_eq!(replaced("a,b", Some("c")), (interface("a"), name("b")));
        assert_eq!(replaced("sim", Some("c")), (Nic::Sim, name("c")));
    }
}

//! Network card checks: suitability for EtherCAT, and what delays frames.

use super::ethtool::Answers;
use super::fix::{Fix, file, write};
use super::{Context, ReportBuilder, Severity};

/// `IFF_UP` in /sys/class/net/…/flags.
const UP: u32 = 1;
/// `ARPHRD_ETHER` in /sys/class/net/…/type.
const ETHERNET: u32 = 1;
const MTU: u32 = 1500;
const NETWORKD: &str = "/etc/systemd/network/10-ecaxis";

pub(super) fn examine(
    context: &Context<'_>,
    nic: &str,
    answers: &Answers,
    notes: &mut ReportBuilder,
) {
    let card = NicCheck {
        context,
        nic,
        answers,
    };
    let driver = card.driver();
    let virtual_one = card.is_virtual();
    notes.fact(
        "NIC",
        match (&driver, virtual_one) {
            (Some(driver), true) => format!("{nic}, virtual, driver {driver}"),
            (Some(driver), false) => format!("{nic}, driver {driver}"),
            (None, true) => format!("{nic}, virtual"),
            (None, false) => nic.to_owned(),
        },
    );
    if !context.host.exists(&card.path("")) {
        return notes.fact("NIC settings", "not visible here");
    }
    if !card.kind(notes) {
        return;
    }
    card.link(virtual_one, notes);
    card.settings(notes);
    card.coalescing(notes);
    card.energy(notes);
    card.traffic(notes);
    card.offloads(notes);
    if driver.as_deref() == Some("veth") {
        pair(context, notes);
    }
}

/// Checks a veth interface, whose peer is on the same computer.
fn pair(context: &Context<'_>, notes: &mut ReportBuilder) {
    if context.intent.cpu.is_some() || context.online.len() < 2 {
        return;
    }
    let take = context.cpu.or(context.online.last()).unwrap_or(0);
    notes.find(
        Severity::Note,
        "same-cpu",
        "the other end of this interface is served by a program on this computer",
        "Where the scheduler puts it on the CPU that the cycle spins on, it does not run, and every reply is late.",
        vec![Fix::advice(format!(
            "write `cpu = {take}` into the machine file's [bus], and start the other program with `taskset` on another CPU"
        ))],
    );
}

struct NicCheck<'a> {
    context: &'a Context<'a>,
    nic: &'a str,
    answers: &'a Answers,
}

impl NicCheck<'_> {
    fn path(&self, attribute: &str) -> String {
        format!("sys/class/net/{}/{attribute}", self.nic)
    }

    fn text(&self, attribute: &str) -> Option<String> {
        self.context.host.text(&self.path(attribute))
    }

    fn number<T: std::str::FromStr>(&self, attribute: &str) -> Option<T> {
        self.context.host.number(&self.path(attribute))
    }

    fn has(&self, attribute: &str) -> bool {
        self.context.host.exists(&self.path(attribute))
    }

    fn driver(&self) -> Option<String> {
        let link = || self.context.host.link(&self.path("device/driver"));
        self.answers.driver.clone().or_else(link)
    }

    fn is_virtual(&self) -> bool {
        self.has("") && !self.has("device")
    }

    /// Checks the type. Returns false if the interface cannot carry EtherCAT.
    fn kind(&self, notes: &mut ReportBuilder) -> bool {
        let nic = self.nic;
        let bad = |notes: &mut ReportBuilder, what: &str, cost: &str, fix: Vec<Fix>| {
            notes.find(
                Severity::Bad,
                "nic-kind",
                format!("`{nic}` {what}"),
                cost,
                fix,
            );
        };
        let other = || Fix::advice("use a dedicated network card for EtherCAT");
        if self.has("wireless") || self.has("phy80211") {
            bad(
                notes,
                "is a wireless interface",
                "EtherCAT needs a cable from device to device: nothing will answer.",
                vec![other()],
            );
            return false;
        }
        if self
            .number::<u32>("type")
            .is_some_and(|kind| kind != ETHERNET)
        {
            bad(
                notes,
                "is not an Ethernet interface",
                "It carries no EtherCAT frames.",
                vec![other()],
            );
            return false;
        }
        if self.has("bridge") || self.has("bonding") {
            bad(
                notes,
                "is a bridge or a bond, not a card",
                "Frames take detours through the kernel and may be sent to other networks.",
                vec![Fix::advice(
                    "name the card itself, and take it out of the bridge or bond",
                )],
            );
            return false;
        }
        if let Some(master) = self.context.host.link(&self.path("master")) {
            bad(
                notes,
                &format!("is a part of `{master}`"),
                "Replies go to the bridge or bond, and other networks' frames onto the bus: frames are lost.",
                vec![Fix::now(format!("sudo ip link set {nic} nomaster"))],
            );
        }
        if self
            .context
            .host
            .link(&self.path("device/subsystem"))
            .as_deref()
            == Some("usb")
        {
            notes.find(
                Severity::Warning,
                "nic-usb",
                format!("`{nic}` is a USB adapter"),
                "USB polls for received frames at its own intervals: replies come 0.1 to 1 ms later, irregularly. Usable only for cycle times of several milliseconds.",
                vec![Fix::advice("take a card on PCI Express, or one of the mainboard's")],
            );
        }
        true
    }

    fn link(&self, virtual_one: bool, notes: &mut ReportBuilder) {
        let nic = self.nic;
        let flags = self.text("flags");
        let flags = flags.and_then(|f| u32::from_str_radix(f.strip_prefix("0x")?, 16).ok());
        if flags.is_some_and(|flags| flags & UP == 0) {
            let mut fix = vec![Fix::now(format!("sudo ip link set {nic} up"))];
            fix.extend(self.left_alone());
            return notes.find(
                Severity::Bad,
                "nic-down",
                format!("`{nic}` is down"),
                "No frame can be sent.",
                fix,
            );
        }
        if self.text("carrier").as_deref() == Some("0") {
            return notes.find(
                Severity::Bad,
                "nic-carrier",
                format!("`{nic}` has no link"),
                "No cable, or nothing powered at its end: nothing will answer.",
                vec![Fix::advice(
                    "connect the first SubDevice's IN port and give it power",
                )],
            );
        }
        let speed = self.number::<i64>("speed").filter(|speed| *speed > 0);
        let duplex = self.text("duplex");
        match (speed, duplex.as_deref()) {
            _ if virtual_one => {}
            (Some(100), Some("full")) => notes.fact("NIC link", "100 Mbit/s full duplex"),
            (Some(speed), Some(duplex @ ("full" | "half"))) => {
                self.wrong_link(speed, duplex, notes)
            }
            _ => notes.fact("NIC link", "up; the driver does not say how fast"),
        }
    }

    fn wrong_link(&self, speed: i64, duplex: &str, notes: &mut ReportBuilder) {
        let nic = self.nic;
        let found = format!("`{nic}` runs at {speed} Mbit/s {duplex} duplex");
        // 0x008 is 100BASE-TX full duplex.
        let again = Fix::now(format!("sudo ethtool -s {nic} autoneg on advertise 0x008"));
        if speed > 100 && duplex == "full" {
            // EtherCAT on copper is 100BASE-TX (IEC 61158-2): SubDevices negotiate nothing else.
            return notes.find(
                Severity::Warning,
                "nic-speed",
                found,
                "EtherCAT devices run at 100 Mbit/s: a switch or another computer is connected. A switch delays every frame.",
                vec![Fix::advice("connect the first SubDevice's IN port directly")],
            );
        }
        notes.find(
            Severity::Bad,
            "nic-speed",
            found,
            "EtherCAT needs 100 Mbit/s full duplex: frames meet their own replies and are lost.",
            vec![
                again,
                Fix::advice("and look at the cable: both pairs are needed"),
            ],
        );
    }

    fn settings(&self, notes: &mut ReportBuilder) {
        let nic = self.nic;
        if let Some(mtu) = self.number::<u32>("mtu").filter(|mtu| *mtu < MTU) {
            notes.find(
                Severity::Bad,
                "nic-mtu",
                format!("`{nic}` carries frames of at most {mtu} bytes (MTU), {MTU} are needed"),
                "The program refuses the interface, because long frames would not get through.",
                vec![Fix::now(format!("sudo ip link set {nic} mtu {MTU}"))],
            );
        }
        if self.text("threaded").as_deref() == Some("1") {
            notes.find(
                Severity::Warning,
                "nic-threaded",
                format!("`{nic}` receives in threads of ordinary priority (threaded NAPI)"),
                "Replies wait until the scheduler gets round to it; on the cycle's CPU they never come in time.",
                write(self.context.host, "0", &format!("/sys/class/net/{nic}/threaded")),
            );
        }
        let (flush, defer) = ("gro_flush_timeout", "napi_defer_hard_irqs");
        if self.number::<u64>(flush).is_some_and(|ns| ns > 0)
            && self.number::<u64>(defer).is_some_and(|n| n > 0)
        {
            notes.find(
                Severity::Warning,
                "nic-deferred",
                format!(
                    "`{nic}` defers its interrupts by {} µs ({flush}, {defer})",
                    self.number::<u64>(flush).unwrap_or(0) / 1_000
                ),
                "Replies lie in the card's memory that long.",
                write(
                    self.context.host,
                    "0",
                    &format!("/sys/class/net/{nic}/{defer}"),
                ),
            );
        }
    }

    fn coalescing(&self, notes: &mut ReportBuilder) {
        let nic = self.nic;
        let Some(coalescing) = self.answers.coalescing else {
            return notes.fact("NIC coalescing", "the driver does not say");
        };
        if coalescing.rx_us == 0 && !coalescing.adaptive_rx {
            return notes.fact("NIC coalescing", "off");
        }
        let (held, cost) = match coalescing {
            c if c.adaptive_rx => (
                "as it finds fit (adaptive)".to_owned(),
                "Each reply waits for its interrupt for a time that changes with the traffic, up to some 100 µs".to_owned(),
            ),
            c => (
                format!("for {} µs", c.rx_us),
                format!(
                    "Each reply waits that long or, with drivers that take small numbers for a mode of their own (igb, igc, e1000e: 1 to 3), up to 50 µs; a cycle of {} has no more than three quarters of that for its frames",
                    ecaxis_master::config::duration::show(self.context.intent.cycle_ns),
                ),
            ),
        };
        let adaptive = if coalescing.adaptive_rx {
            "adaptive-rx off "
        } else {
            ""
        };
        let lasting = match coalescing.adaptive_rx {
            true => &["UseAdaptiveRxCoalesce=no", "RxCoalesceSec=0"][..],
            false => &["RxCoalesceSec=0"],
        };
        let mut fix = vec![Fix::now(format!(
            "sudo ethtool -C {nic} {adaptive}rx-usecs 0"
        ))];
        fix.extend(self.link_file(lasting));
        notes.find(
            Severity::Warning,
            "nic-coalescing",
            format!("`{nic}` collects received frames {held} before it interrupts"),
            format!("{cost}."),
            fix,
        );
    }

    /// Returns the .link file that systemd-udevd applies when the card appears.
    fn link_file(&self, settings: &[&str]) -> Option<Fix> {
        let mac = self.text("address").filter(|mac| is_mac(mac))?;
        let mac = format!("MACAddress={mac}");
        // The file replaces the one that sets interface names.
        let names = "NamePolicy=keep kernel database onboard slot path";
        let lines = [&["[Match]", &mac, "[Link]", names], settings].concat();
        self.systemd()
            .then(|| Fix::lasting(file(&lines, &format!("{NETWORKD}.link"))))
    }

    fn systemd(&self) -> bool {
        !self.context.container && self.context.host.exists("run/systemd/system")
    }

    fn energy(&self, notes: &mut ReportBuilder) {
        let nic = self.nic;
        let Some(eee) = self.answers.energy_efficient else {
            return;
        };
        if !eee.enabled {
            return notes.fact("NIC energy saving", "off (EEE)");
        }
        let (severity, found, cost) = match eee.active {
            true => (
                Severity::Warning,
                "puts the link to sleep between frames (EEE)",
                "Waking the link takes 30 µs a frame at 100 Mbit/s (IEEE 802.3az), and some devices lose the link altogether.",
            ),
            false => (
                Severity::Note,
                "would put the link to sleep between frames (EEE); the other end does not take part",
                "Nothing with this device at the other end; with another, 30 µs a frame and lost links.",
            ),
        };
        let fix = vec![Fix::now(format!("sudo ethtool --set-eee {nic} eee off"))];
        notes.find(severity, "nic-eee", format!("`{nic}` {found}"), cost, fix);
    }

    /// Checks for traffic of other programs on the bus.
    fn traffic(&self, notes: &mut ReportBuilder) {
        let nic = self.nic;
        if let Some(manager) = self.manager() {
            let mut fix = Vec::new();
            if manager == "NetworkManager" {
                fix.push(Fix::now(format!("sudo nmcli device set {nic} managed no")));
                let own = format!("unmanaged-devices=interface-name:{nic}");
                let file = file(
                    &["[keyfile]", &own],
                    "/etc/NetworkManager/conf.d/90-ecaxis.conf",
                );
                fix.push(Fix::lasting(format!(
                    "{file} && sudo systemctl reload NetworkManager"
                )));
            } else {
                fix.extend(self.left_alone());
            }
            notes.find(
                Severity::Warning,
                "nic-managed",
                format!("{manager} manages `{nic}`"),
                "It sends frames of its own (DHCP, IPv6) between the cycle's, and takes the interface down when it gets no answer: the bus is lost.",
                fix,
            );
        }
        let addresses = &self.answers.addresses;
        if addresses.is_empty() {
            return notes.fact("NIC addresses", "none");
        }
        let local = addresses.iter().all(|a| a.starts_with("fe80:"));
        let mut fix = vec![Fix::now(format!(
            "sudo ip address flush dev {nic}; sudo sysctl net.ipv6.conf.{nic}.disable_ipv6=1"
        ))];
        if !local {
            fix.insert(
                0,
                Fix::advice(
                    "This may be the interface that you work over: EtherCAT needs one of its own.",
                ),
            );
        }
        fix.push(Fix::lasting(format!(
            "echo net.ipv6.conf.{nic}.disable_ipv6=1 | sudo tee -a /etc/sysctl.d/90-ecaxis.conf"
        )));
        notes.find(
            if local { Severity::Note } else { Severity::Warning },
            "nic-address",
            format!("`{nic}` has IP addresses: {}", addresses.join(", ")),
            "The computer sends its own frames onto the bus; one of 1500 bytes holds up the cycle's by 120 µs.",
            fix,
        );
    }

    /// Returns the program that configures the interface.
    fn manager(&self) -> Option<&'static str> {
        let host = self.context.host;
        let index: u32 = self.number("ifindex")?;
        let says = |path: String, line: &str| {
            let text = host.text(&path).unwrap_or_default();
            text.lines().any(|l| l.trim() == line)
        };
        // /run may outlive the program.
        if self.runs("NetworkManager")
            && says(
                format!("run/NetworkManager/devices/{index}"),
                "managed=true",
            )
        {
            return Some("NetworkManager");
        }
        let networkd = format!("run/systemd/netif/links/{index}");
        let managed = ["configured", "configuring", "pending", "degraded", "failed"]
            .iter()
            .any(|state| says(networkd.clone(), &format!("ADMIN_STATE={state}")));
        // systemd-network: thread names have at most 15 characters.
        (self.runs("systemd-network") && managed).then_some("systemd-networkd")
    }

    /// Returns the systemd-networkd file that brings the interface up without an address. `None` if
    /// NetworkManager is used.
    fn left_alone(&self) -> Option<Fix> {
        let name = format!("Name={}", self.nic);
        let lines = [
            "[Match]",
            &name,
            "[Link]",
            "ActivationPolicy=always-up",
            "RequiredForOnline=no",
            "[Network]",
            "LinkLocalAddressing=no",
            "LLDP=no",
        ];
        let file = file(&lines, &format!("{NETWORKD}.network"));
        self.runs("systemd-network")
            .then(|| Fix::lasting(format!("{file} && sudo networkctl reload")))
    }

    fn runs(&self, name: &str) -> bool {
        self.context.threads.iter().any(|t| t.name == name)
    }

    fn offloads(&self, notes: &mut ReportBuilder) {
        let nic = self.nic;
        let a = self.answers;
        if a.lro == Some(true) {
            notes.find(
                Severity::Note,
                "nic-lro",
                format!("`{nic}` may join received frames to larger ones (LRO)"),
                "Some cards hold frames back for that, EtherCAT's too.",
                vec![Fix::now(format!("sudo ethtool -K {nic} lro off"))],
            );
        }
        // GRO does not merge EtherCAT frames, and they have no VLAN tags: information only.
        let reported = [
            ("GRO", a.gro),
            ("LRO", a.lro),
            ("VLAN stripping", a.rx_vlan),
        ];
        let reported: Vec<String> = reported
            .into_iter()
            .filter_map(|(name, on)| Some(format!("{name} {}", if on? { "on" } else { "off" })))
            .collect();
        if !reported.is_empty() {
            notes.fact("NIC offloads", reported.join(", "));
        }
        let ring = a
            .ring
            .map(|(used, most)| format!("{used} of {most} receive descriptors"));
        let queues = a.queues.filter(|n| *n > 0);
        let queues = queues.map(|n| format!("{n} receive queue{}", if n == 1 { "" } else { "s" }));
        let both: Vec<String> = queues.into_iter().chain(ring).collect();
        if !both.is_empty() {
            notes.fact("NIC queues", both.join(", "));
        }
    }
}

/// True for the sysfs notation `00:1b:21:0a:0b:0c`.
fn is_mac(text: &str) -> bool {
    let mut bytes = 0;
    text.split(':').all(|byte| {
        bytes += 1;
        byte.len() == 2 && byte.bytes().all(|b| b.is_ascii_hexdigit())
    }) && bytes == 6
}

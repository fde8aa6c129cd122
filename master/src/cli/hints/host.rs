//! Advice about the computer: its interfaces, and what it permits.

use ecaxis::link::{Concern, OpenError};
use ecaxis::rt::thread::Denied;

use super::{Failure, WRONG};

pub(crate) fn interface(failure: Failure, error: &OpenError) -> Failure {
    match error {
        OpenError::NoSuchInterface { .. } => {
            // The file or the command line names it.
            Failure {
                code: WRONG,
                ..failure
            }
            .hint(interfaces())
        }
        OpenError::NotPermitted { .. } => failure.hint(capabilities()),
        OpenError::Down { nic } => failure.hint(format!("sudo ip link set {nic} up")),
        OpenError::NoCarrier { .. } => {
            failure.hint("plug the cable into the first SubDevice's IN port and switch it on")
        }
        OpenError::Mtu { nic, .. } => failure.hint(format!("sudo ip link set {nic} mtu 1500")),
        OpenError::Unfit { .. } => Failure {
            code: WRONG,
            ..failure
        }
        .hint(interfaces()),
        OpenError::Taken { pid, .. } => {
            let stop = match pid {
                Some(pid) => format!("Ctrl-C there, or `kill -INT {pid}`,"),
                None => "Ctrl-C there".to_owned(),
            };
            failure
                .hint(format!(
                    "{stop} brings its axes to rest and its bus to Init"
                ))
                .hint("`ecaxis scan`, `sdo` and `eeprom` go beside a machine that runs")
        }
        OpenError::Driven { .. } => failure
            .hint("two of them move the same drives: bring its axes to rest and end it first")
            .hint("`ecaxis scan` goes beside a machine that runs"),
        OpenError::NoRing { .. } => failure.hint("write `link = \"packet\"` into [bus]"),
        OpenError::Io { .. } => failure,
    }
}

/// What mends something about an interface.
pub(crate) fn concern(concern: &Concern) -> Option<String> {
    match concern {
        Concern::Addresses { nic, .. } => Some(format!(
            "sudo ip addr flush dev {nic} && sudo sysctl -w net.ipv6.conf.{nic}.disable_ipv6=1; where NetworkManager runs, \
             sudo nmcli device set {nic} managed no"
        )),
        Concern::Member { nic, .. } => Some(format!("sudo ip link set {nic} nomaster")),
        Concern::NoRing { .. } => None,
    }
}

/// The interfaces of this computer.
pub(super) fn interfaces() -> String {
    let names = ecaxis::link::interface::interfaces();
    if names.is_empty() {
        return "this computer has no network interface for EtherCAT; `--sim` runs without one"
            .to_owned();
    }
    format!("this computer has {}", names.join(", "))
}

/// How to permit raw sockets, real-time priority and locked memory without being root.
pub(crate) fn capabilities() -> String {
    let exe = std::env::current_exe().unwrap_or_else(|_| "ecaxis".into());
    format!(
        "sudo setcap cap_net_raw,cap_sys_nice,cap_ipc_lock+ep {}",
        exe.display()
    )
}

/// What permits what the operating system denied.
pub(crate) fn denied(denied: &Denied) -> String {
    match denied {
        Denied::Priority { .. } | Denied::MemoryLock { .. } => capabilities(),
        Denied::Affinity { .. } => {
            let last = std::thread::available_parallelism().map_or(0, |n| n.get() - 1);
            format!("`cpu` in [bus] must be one that this process may use: often 0 to {last}")
        }
        Denied::CpuLatency { .. } => {
            "sudo setfacl -m u:$USER:w /dev/cpu_dma_latency, or a udev rule for good".to_owned()
        }
        Denied::Awake { .. } => "leave `idle` out of [bus]".to_owned(),
    }
}

/// What gives a real-time thread some air.
pub(crate) fn overload() -> &'static str {
    "a longer `cycle` or a shorter `spin` in [bus] takes less of the CPU; `sudo sysctl -w kernel.sched_rt_runtime_us=-1` lifts the limit, for a CPU that nobody else needs"
}

//! Advice about the computer: interfaces and permissions.

use ecaxis_master::link::{NicWarning, OpenError};
use ecaxis_master::sys::rt_thread::RtSetupError;

use super::{Failure, WRONG};

pub(crate) fn interface(failure: Failure, error: &OpenError) -> Failure {
    match error {
        OpenError::NoSuchInterface { .. } => {
            // The interface name is a user input.
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
                .hint(format!("{stop} stops its axes and brings its bus to Init"))
                .hint("`ecaxis scan`, `sdo` and `eeprom` can be used while a machine runs")
        }
        OpenError::Driven { .. } => failure
            .hint("two of them move the same drives: bring its axes to rest and end it first")
            .hint("`ecaxis scan` can be used while a machine runs"),
        OpenError::NoRing { .. } => failure.hint("write `link = \"packet\"` into [bus]"),
        OpenError::Io { .. } => failure,
    }
}

/// Returns the command that fixes a problem of an interface.
pub(crate) fn concern(concern: &NicWarning) -> Option<String> {
    match concern {
        NicWarning::Addresses { nic, .. } => Some(format!(
            "sudo ip addr flush dev {nic} && sudo sysctl -w net.ipv6.conf.{nic}.disable_ipv6=1; where NetworkManager runs, \
             sudo nmcli device set {nic} managed no"
        )),
        NicWarning::Member { nic, .. } => Some(format!("sudo ip link set {nic} nomaster")),
        NicWarning::NoRing { .. } | NicWarning::NoLink { .. } => None,
    }
}

/// Lists the interfaces of this computer.
pub(crate) fn interfaces() -> String {
    let names = ecaxis_master::link::interface::interfaces();
    if names.is_empty() {
        return "this computer has no network interface for EtherCAT; `--sim` runs without one"
            .to_owned();
    }
    format!("this computer has {}", names.join(", "))
}

/// Returns the command that permits raw sockets, real-time priority and locked memory without root.
pub(crate) fn capabilities() -> String {
    let exe = std::env::current_exe().unwrap_or_else(|_| "ecaxis".into());
    format!(
        "sudo setcap cap_net_raw,cap_sys_nice,cap_ipc_lock+ep {}",
        exe.display()
    )
}

/// Returns the command or setting that permits what the operating system denied.
pub(crate) fn denied(denied: &RtSetupError) -> String {
    match denied {
        RtSetupError::Priority { .. } | RtSetupError::MemoryLock { .. } => capabilities(),
        RtSetupError::Affinity { .. } => {
            let last = std::thread::available_parallelism().map_or(0, |n| n.get() - 1);
            format!("`cpu` in [bus] must be one that this process may use: often 0 to {last}")
        }
        RtSetupError::CpuLatency { .. } => {
            "sudo setfacl -m u:$USER:w /dev/cpu_dma_latency, or add a udev rule".to_owned()
        }
        RtSetupError::Awake { .. } => "omit `idle` in [bus]".to_owned(),
    }
}

/// Returns the advice for a real-time thread that uses too much CPU time.
pub(crate) fn overload() -> &'static str {
    "a longer `cycle` or a shorter `spin` in [bus] uses less CPU time; `sudo sysctl -w kernel.sched_rt_runtime_us=-1` removes the limit, for a CPU without other work"
}

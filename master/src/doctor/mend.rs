//! How things are changed, in the way of the system at hand.

use serde::Serialize;

use super::host::Host;

/// A step of mending.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(tag = "kind", content = "text", rename_all = "lowercase")]
pub enum Mend {
    /// A command that changes it until the next boot.
    Now(String),
    /// A command that changes it for good.
    Lasting(String),
    /// What no command does.
    Advice(String),
}

impl Mend {
    pub(super) fn now(command: impl Into<String>) -> Self {
        Self::Now(command.into())
    }

    pub(super) fn lasting(command: impl Into<String>) -> Self {
        Self::Lasting(command.into())
    }

    pub(super) fn advice(text: impl Into<String>) -> Self {
        Self::Advice(text.into())
    }
}

/// Images of containers also run as whole computers; those see the kernel's own threads.
pub(super) fn in_container(host: &Host) -> bool {
    if host.text("proc/2/comm").as_deref() == Some("kthreadd") {
        return false;
    }
    let marks = [".dockerenv", "run/.containerenv", "run/systemd/container"];
    let environment = || host.text("proc/1/environ").unwrap_or_default();
    marks.iter().any(|mark| host.exists(mark))
        || environment()
            .split('\0')
            .any(|v| v.starts_with("container="))
}

/// Adds to the kernel's command line.
pub(super) fn boot(host: &Host, parameters: &str) -> Mend {
    if in_container(host) {
        return Mend::advice(format!(
            "boot the computer that the container runs on with `{parameters}`"
        ));
    }
    if host.exists("usr/sbin/grubby") {
        return Mend::lasting(format!(
            "sudo grubby --update-kernel=ALL --args=\"{parameters}\" && sudo reboot"
        ));
    }
    if host.exists("etc/default/grub.d") {
        // The format is used once a parameter.
        return Mend::lasting(format!(
            "printf 'GRUB_CMDLINE_LINUX=\"$GRUB_CMDLINE_LINUX %s\"\\n' {parameters} | sudo tee -a /etc/default/grub.d/ecaxis.cfg && sudo update-grub && sudo reboot"
        ));
    }
    for file in ["boot/firmware/cmdline.txt", "boot/cmdline.txt"] {
        if host.exists(file) {
            return Mend::lasting(format!(
                "sudo sed -i 's/$/ {parameters}/' /{file} && sudo reboot"
            ));
        }
    }
    Mend::advice(format!(
        "add `{parameters}` to the kernel's command line (in the boot loader, or where the virtual machine is defined), then boot"
    ))
}

/// A kernel setting under /proc/sys.
pub(super) fn sysctl(key: &str, value: &str) -> Vec<Mend> {
    vec![
        Mend::now(format!("sudo sysctl {key}={value}")),
        Mend::lasting(format!(
            "echo {key}={value} | sudo tee -a /etc/sysctl.d/90-ecaxis.conf"
        )),
    ]
}

/// A value that is written to a file of /sys; for good by systemd where it runs the computer.
pub(super) fn write(host: &Host, value: &str, path: &str) -> Vec<Mend> {
    let mut mend = vec![Mend::now(format!("echo {value} | sudo tee {path}"))];
    if host.exists("run/systemd/system") {
        mend.push(Mend::lasting(format!(
            "printf 'w %s - - - - {value}\\n' {path} | sudo tee -a /etc/tmpfiles.d/ecaxis.conf"
        )));
    }
    mend
}

/// Several lines into a new file.
pub(super) fn file(lines: &[&str], path: &str) -> String {
    let lines: Vec<String> = lines.iter().map(|line| format!("'{line}'")).collect();
    format!("printf '%s\\n' {} | sudo tee {path}", lines.join(" "))
}

//! Fixes: commands and advice for the present system.

use serde::Serialize;

use crate::host::Host;

/// One step of a fix.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(tag = "kind", content = "text", rename_all = "lowercase")]
pub enum Fix {
    /// A command that lasts until the next boot.
    Now(String),
    /// A permanent command.
    Lasting(String),
    /// Advice without a command.
    Advice(String),
}

impl Fix {
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

/// True in a container. Container images can also run as whole computers; those see kernel threads.
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

/// Returns the fix that adds kernel command-line parameters.
pub(super) fn boot(host: &Host, parameters: &str) -> Fix {
    if in_container(host) {
        return Fix::advice(format!(
            "boot the computer that the container runs on with `{parameters}`"
        ));
    }
    if host.exists("usr/sbin/grubby") {
        return Fix::lasting(format!(
            "sudo grubby --update-kernel=ALL --args=\"{parameters}\" && sudo reboot"
        ));
    }
    if host.exists("etc/default/grub.d") {
        // printf applies the format to each parameter.
        return Fix::lasting(format!(
            "printf 'GRUB_CMDLINE_LINUX=\"$GRUB_CMDLINE_LINUX %s\"\\n' {parameters} | sudo tee -a /etc/default/grub.d/ecaxis.cfg && sudo update-grub && sudo reboot"
        ));
    }
    for file in ["boot/firmware/cmdline.txt", "boot/cmdline.txt"] {
        if host.exists(file) {
            return Fix::lasting(format!(
                "sudo sed -i 's/$/ {parameters}/' /{file} && sudo reboot"
            ));
        }
    }
    Fix::advice(format!(
        "add `{parameters}` to the kernel's command line (in the boot loader, or where the virtual machine is defined), then boot"
    ))
}

/// Returns the fix for a kernel setting under /proc/sys.
pub(super) fn sysctl(key: &str, value: &str) -> Vec<Fix> {
    vec![
        Fix::now(format!("sudo sysctl {key}={value}")),
        Fix::lasting(format!(
            "echo {key}={value} | sudo tee -a /etc/sysctl.d/90-ecaxis.conf"
        )),
    ]
}

/// Returns the fix that writes a value to a file in /sys, permanent with systemd.
pub(super) fn write(host: &Host, value: &str, path: &str) -> Vec<Fix> {
    let mut fix = vec![Fix::now(format!("echo {value} | sudo tee {path}"))];
    if host.exists("run/systemd/system") {
        fix.push(Fix::lasting(format!(
            "printf 'w %s - - - - {value}\\n' {path} | sudo tee -a /etc/tmpfiles.d/ecaxis.conf"
        )));
    }
    fix
}

/// Returns the command that writes lines to a new file.
pub(super) fn file(lines: &[&str], path: &str) -> String {
    let lines: Vec<String> = lines.iter().map(|line| format!("'{line}'")).collect();
    format!("printf '%s\\n' {} | sudo tee {path}", lines.join(" "))
}

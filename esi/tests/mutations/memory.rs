//! The peak resident memory of this process on Linux; elsewhere 0.

/// Resets the peak.
pub fn reset() {
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

pub fn peak() -> usize {
    status("VmHWM:")
}

fn status(key: &str) -> usize {
    let text = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = text.lines().find_map(|line| line.strip_prefix(key));
    let kilobytes = line.and_then(|line| line.split_whitespace().next());
    kilobytes
        .and_then(|kb| kb.parse::<usize>().ok())
        .unwrap_or(0)
        << 10
}

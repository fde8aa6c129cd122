//! The load of a CAN network, and the time that set-points take over it.

use ecaxis_sim::gateway::{GatewayOptions, Supervision};

use super::{GatewaySetup, MS, bytes};

/// Returns the bits of a frame with this number of data bytes and most stuff bits, gap included.
const fn frame_bits(bytes: u64) -> u64 {
    47 + 8 * bytes + (34 + 8 * bytes - 1) / 4
}

/// The highest load of a CAN network: above it, frames with high identifiers wait for others.
pub(super) const MAX_LOAD: f64 = 0.6;

/// Returns the share of time for which frames occupy the network. Each PDO passes once per SYNC.
pub(super) fn load(setup: &GatewaySetup, simulated: &GatewayOptions, sync_ns: u64) -> f64 {
    let links = setup
        .nodes
        .iter()
        .flat_map(|n| n.outputs.iter().chain(&n.inputs));
    let pdos: u64 = links.map(|link| frame_bits(bytes(link).into())).sum();
    let per_sync = frame_bits(0) + pdos;
    let heartbeats = simulated.nodes.iter().map(|node| match node.supervision {
        Supervision::Heartbeat { period_ms } => {
            frame_bits(1) as f64 * 1e3 / f64::from(period_ms.max(1))
        }
        _ => 0.0,
    });
    let rate = per_sync as f64 * 1e9 / sync_ns as f64 + heartbeats.sum::<f64>();
    rate / f64::from(setup.bit_rate)
}

impl GatewaySetup {
    /// Returns the time from a set-point to the report of its position: it is held for one SYNC
    /// period; the cycle that carries it, the gateway's exchange, the longest PDO and SYNC add to
    /// that.
    #[must_use]
    pub fn dead_time_ns(&self, cycle_ns: u64) -> u64 {
        const EXCHANGE_NS: u64 = MS;
        let links = self
            .nodes
            .iter()
            .flat_map(|n| n.outputs.iter().chain(&n.inputs));
        let longest = links.map(|link| frame_bits(bytes(link).into())).max();
        let bits = frame_bits(0) + longest.unwrap_or(0);
        let frames = bits * 1_000_000_000 / u64::from(self.bit_rate.max(1));
        self.sync_ns + cycle_ns + EXCHANGE_NS + frames
    }
}

//! Remarks on figures that need caution.

use super::plan::{Plan, Target};
use super::report::{FEW, Variant, losses};
use crate::host::Host;

/// The stolen share of CPU time above which rare wake-ups are affected.
const STEAL: f64 = 0.0005;

/// Returns the remarks on these variants.
#[must_use]
pub fn of(plan: &Plan, variants: &[Variant]) -> Vec<String> {
    let mut remarks = Vec::new();
    if cfg!(debug_assertions) {
        remarks.push(
            "this is a development build: work and CPU are several times those of a release build"
                .to_owned(),
        );
    }
    if plan.other_cpu.is_none() {
        remarks.push(
            "there is one CPU only: the bus and the cycle take turns on it, and no time is meaningful".to_owned(),
        );
    }
    if Host::here().is_virtual() {
        remarks.push(
            "this is a virtual machine: p99.9 and max are as much the hypervisor's as this program's; compare within the table only".to_owned(),
        );
    }
    for variant in variants {
        remarks.extend(of_one(plan, variant));
    }
    if let Target::Machine { .. } = plan.target {
        remarks.push("the way to Op and back is in the figures".to_owned());
    }
    if matches!(plan.target, Target::InProcess) {
        remarks.push(
            "in process, frames are not exchanged: release to input does not describe a network interface"
                .to_owned(),
        );
    }
    remarks
}

fn of_one(plan: &Plan, variant: &Variant) -> Vec<String> {
    let mut remarks = Vec::new();
    let name = &variant.name;
    let wall = variant.cycles.saturating_mul(plan.cycle_ns) as f64;
    let steal_ns = variant.taken.as_ref().and_then(|taken| taken.steal_ns);
    if let Some(steal_ns) = steal_ns
        && steal_ns as f64 > wall * STEAL
    {
        remarks.push(format!(
            "{name}: the hypervisor took {:.1} % of CPU {} for others: its p99.9 and max do not characterize this program",
            steal_ns as f64 / wall * 100.0,
            plan.cpu
        ));
    }
    if variant.cycles < FEW {
        remarks.push(format!(
            "{name}: {} cycles are too few for a 99th percentile",
            variant.cycles
        ));
    }
    if let Some(used) = variant.used
        && variant.spin_ns.is_some()
        && used.involuntary_switches > 0
    {
        remarks.push(format!(
            "{name}: {} times another thread took the CPU from the cycle",
            used.involuntary_switches
        ));
    }
    if let Some((lost, ours)) = losses(variant)
        && lost > 0
        && variant.spin_ns.is_some()
    {
        let cycles = if lost == 1 { "cycle" } else { "cycles" };
        let why = match (variant.bus, variant.late_releases.unwrap_or(0)) {
            (None, _) => "and the bus does not say why".to_owned(),
            (Some(_), _) if ours == 0 => {
                "all of them by replies that were held back at the other end".to_owned()
            }
            (Some(_), late) if late >= ours => format!(
                "{} by replies held back at the other end, the others by wake-ups that this computer delayed ({late} of them)",
                lost - ours
            ),
            (Some(_), late) => format!(
                "{} by replies held back at the other end, {late} by wake-ups that this computer delayed, {} unaccounted for",
                lost - ours,
                ours - late
            ),
        };
        remarks.push(format!("{name}: {lost} lost {cycles}, {why}"));
    }
    if let Some(bus) = variant.bus
        && bus.held_up * 100 > bus.frames
    {
        remarks.push(format!(
            "{name}: {:.1} % of the replies were delayed by this computer: release to input includes the delay",
            bus.held_up as f64 / bus.frames.max(1) as f64 * 100.0
        ));
    }
    remarks
}

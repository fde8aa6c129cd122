use proptest::prelude::*;

use super::*;

const DT: f64 = 0.001;

fn set(axes: &[usize]) -> AxisSet {
    axes.iter().copied().collect()
}

/// The default table, row by row: axis 1 of 0, 1, 2 has the cause; axis 3 is in another group.
#[test]
fn default_reactions() {
    use Reaction::{Continue, Disable, QuickStop, RampAndDisable};
    let events = |cause| {
        let mut events = Events::default();
        match cause {
            Cause::Fault => events.fault.insert(1),
            Cause::Trip => events.trip.insert(1),
            Cause::Missing => events.missing.insert(1),
            Cause::BusLost => events.bus_lost = true,
            Cause::EmergencyStop => events.emergency_stop = set(&[1]),
        }
        events
    };
    for (cause, own, others, elsewhere) in [
        (Cause::Fault, Disable, RampAndDisable, Continue),
        (Cause::Trip, QuickStop, RampAndDisable, Continue),
        (Cause::Missing, QuickStop, RampAndDisable, Continue),
        (Cause::BusLost, QuickStop, QuickStop, QuickStop),
        (Cause::EmergencyStop, QuickStop, QuickStop, Continue),
    ] {
        let mut first = ReactionGroup::new(set(&[0, 1, 2]), Reactions::default(), 1.0);
        let mut second = ReactionGroup::new(set(&[3]), Reactions::default(), 1.0);
        let stops = first
            .step(&events(cause), DT)
            .or(second.step(&events(cause), DT));
        assert_eq!(
            [0, 1, 2, 3, 4].map(|axis| stops.reaction(axis)),
            [others, own, others, elsewhere, Continue],
            "{cause:?}"
        );
        assert_eq!(first.first().unwrap().0, cause);
        // The cause passes, the reaction stays.
        let after = first.step(&Events::default(), DT);
        assert_eq!(after.reaction(0), others, "{cause:?}");
        first.acknowledge();
        assert_eq!(first.step(&Events::default(), DT), Stops::default());
        assert_eq!(first.first(), None);
    }
}

#[test]
fn who_is_late_loses_power() {
    let mut group = ReactionGroup::new(set(&[0, 1, 2]), Reactions::default(), 0.0105);
    let mut events = Events {
        trip: set(&[0]),
        at_rest: set(&[1]),
        ..Events::default()
    };
    for cycle in 0..30 {
        events.trip = if cycle == 0 {
            set(&[0])
        } else {
            AxisSet::EMPTY
        };
        let stops = group.step(&events, DT);
        let late = cycle > 10;
        let expected = |before| if late { Reaction::Disable } else { before };
        assert_eq!(stops.reaction(0), expected(Reaction::QuickStop), "{cycle}");
        assert_eq!(stops.reaction(1), Reaction::RampAndDisable);
        assert_eq!(
            stops.reaction(2),
            expected(Reaction::RampAndDisable),
            "{cycle}"
        );
    }
}

#[test]
fn the_first_cause_is_kept_and_the_stronger_reaction_done() {
    let mut group = ReactionGroup::new(AxisSet::ALL, Reactions::default(), 1.0);
    let mut events = Events {
        missing: set(&[5]),
        ..Events::default()
    };
    group.step(&events, DT);
    events.bus_lost = true;
    events.fault = set(&[6]);
    let stops = group.step(&events, DT);
    assert_eq!(group.first(), Some((Cause::Missing, set(&[5]))));
    assert_eq!(stops.reaction(5), Reaction::QuickStop);
    assert_eq!(stops.reaction(6), Reaction::Disable);
    assert_eq!(stops.reaction(127), Reaction::QuickStop);
    assert_eq!(stops.reaction(128), Reaction::Continue);
}

#[test]
fn an_axis_that_may_go_on_does() {
    let alone = Reactions {
        fault: [Reaction::Disable, Reaction::Continue],
        missing: [Reaction::Continue, Reaction::Continue],
        ..Reactions::default()
    };
    let mut group = ReactionGroup::new(AxisSet::first(4), alone, 1.0);
    let events = Events {
        missing: set(&[0, 1]),
        ..Events::default()
    };
    assert_eq!(group.step(&events, DT), Stops::default());
    assert_eq!(group.first(), None);
    let events = Events {
        fault: set(&[3]),
        ..Events::default()
    };
    let stops = group.step(&events, DT);
    assert_eq!(stops.disable, set(&[3]));
    assert_eq!(stops.reaction(0), Reaction::Continue);
}

fn axes() -> impl Strategy<Value = AxisSet> {
    prop_oneof![
        3 => Just(AxisSet::EMPTY),
        2 => prop::collection::vec(0usize..140, 0..6).prop_map(|v| v.into_iter().collect()),
        1 => any::<u128>().prop_map(AxisSet),
    ]
}

proptest! {
    /// An axis is in one set at most, only members react, and until acknowledged nothing becomes weaker.
    #[test]
    fn reactions_only_grow(
        members in axes(),
        cycles in prop::collection::vec((axes(), axes(), axes(), any::<bool>(), axes(), axes(), any::<f64>()), 1..20),
        within in any::<f64>(),
    ) {
        let mut group = ReactionGroup::new(members, Reactions::default(), within);
        let mut before = Stops::default();
        for (fault, trip, missing, bus_lost, emergency_stop, at_rest, dt) in cycles {
            let events = Events { fault, trip, missing, bus_lost, emergency_stop, at_rest };
            let stops = group.step(&events, dt);
            let sets = [stops.ramp, stops.ramp_and_disable, stops.quick_stop, stops.disable];
            let together: usize = sets.iter().map(|set| set.len()).sum();
            let all = sets.into_iter().fold(AxisSet::EMPTY, AxisSet::or);
            prop_assert_eq!(together, all.len());
            prop_assert!(all.without(members).is_empty());
            for axis in 0..MAX_AXES {
                prop_assert!(stops.reaction(axis) >= before.reaction(axis));
            }
            before = stops;
        }
    }
}

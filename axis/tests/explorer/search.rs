//! Breadth-first search over the reduced states of a system.

use std::collections::{BTreeMap, HashSet};
use std::fmt::Debug;

/// The first violation of each rule and text, its origin and action, and their number.
type Violations<'a, A> = BTreeMap<(&'a str, String), (Violation, usize, A, u64)>;

/// A rule that does not hold.
#[derive(Debug, Clone)]
pub struct Violation {
    pub rule: &'static str,
    pub detail: String,
}

/// A system that is explored: it has a state, and an action changes it.
pub trait System: Clone {
    type Action: Copy + Debug;

    /// Lists the actions that are possible in this state.
    fn actions(&self, list: &mut Vec<Self::Action>);

    /// Executes an action and checks every cycle of it. `trace` receives a line per cycle.
    fn apply(&mut self, action: Self::Action, trace: Option<&mut String>) -> Result<(), Violation>;

    /// Returns the hash of the reduced state.
    fn key(&self) -> u64;
}

/// The bounds of a search.
#[derive(Debug, Clone, Copy)]
pub struct Bounds {
    /// The largest number of actions after a root.
    pub depth: usize,
    /// The largest number of transitions.
    pub transitions: u64,
    /// The largest number of states of one depth.
    pub width: usize,
}

/// The shortest way to a violation.
#[derive(Debug)]
pub struct CounterExample {
    pub violation: Violation,
    pub trace: String,
    /// The number of transitions that violate the same rule after the same kind of action.
    pub count: u64,
}

#[derive(Debug, Default)]
pub struct Summary {
    pub transitions: u64,
    pub states: usize,
    /// The states of each depth.
    pub levels: Vec<usize>,
    /// False if a bound other than the depth has ended the search.
    pub complete: bool,
    pub found: Vec<CounterExample>,
}

/// A state that was reached: its predecessor, or its root, and the action.
#[derive(Debug, Clone, Copy)]
enum Origin<A> {
    Root(usize),
    Step(usize, A),
}

/// Searches from all roots. The first state with a key stands for all states with this key.
pub fn explore<S: System>(roots: &[(&str, S)], bounds: Bounds) -> Summary {
    let mut visited = HashSet::new();
    let mut origins: Vec<Origin<S::Action>> = Vec::new();
    let mut frontier = Vec::new();
    for (index, (_, root)) in roots.iter().enumerate() {
        if visited.insert(root.key()) {
            frontier.push((origins.len(), root.clone()));
            origins.push(Origin::Root(index));
        }
    }
    let mut summary = Summary {
        complete: true,
        ..Summary::default()
    };
    let mut found: Violations<'_, S::Action> = BTreeMap::new();
    let mut list = Vec::new();
    'levels: for depth in 0..bounds.depth {
        summary.levels.push(frontier.len());
        let mut next = Vec::new();
        for (id, system) in &frontier {
            list.clear();
            system.actions(&mut list);
            for &action in &list {
                if summary.transitions >= bounds.transitions {
                    summary.complete = false;
                    break 'levels;
                }
                summary.transitions += 1;
                let mut after = system.clone();
                match after.apply(action, None) {
                    Ok(()) => {
                        // The states of the last depth are counted and not expanded.
                        if visited.insert(after.key()) && depth + 1 < bounds.depth {
                            if next.len() >= bounds.width {
                                summary.complete = false;
                                continue;
                            }
                            next.push((origins.len(), after));
                            origins.push(Origin::Step(*id, action));
                        }
                    }
                    Err(violation) => {
                        // Waits of all lengths are one kind.
                        let kind = format!("{action:?}").replace(char::is_numeric, "");
                        found
                            .entry((violation.rule, kind))
                            .and_modify(|(.., count)| *count += 1)
                            .or_insert((violation, *id, action, 1));
                    }
                }
            }
        }
        frontier = next;
    }
    summary.states = visited.len();
    let mut found: Vec<_> = found.into_values().collect();
    found.sort_by_key(|&(_, id, ..)| id);
    summary.found = found
        .into_iter()
        .map(|(violation, id, action, count)| CounterExample {
            trace: replay(roots, &origins, id, action),
            violation,
            count,
        })
        .collect();
    summary
}

/// Repeats the actions up to a violation and returns a line per cycle.
fn replay<S: System>(
    roots: &[(&str, S)],
    origins: &[Origin<S::Action>],
    mut id: usize,
    last: S::Action,
) -> String {
    let mut actions = vec![last];
    let root = loop {
        match origins[id] {
            Origin::Root(root) => break root,
            Origin::Step(before, action) => {
                actions.push(action);
                id = before;
            }
        }
    };
    let (name, system) = &roots[root];
    let mut system = system.clone();
    let mut text = format!("from: {name}\n");
    for &action in actions.iter().rev() {
        text.push_str(&format!("- {action:?}\n"));
        if let Err(violation) = system.apply(action, Some(&mut text)) {
            text.push_str(&format!("! {}: {}\n", violation.rule, violation.detail));
        }
    }
    text
}

//! Assigns the devices on the bus to those of the machine file, for bring-up and `compare`.

/// The maximum length of a list; longer lists are not aligned (a quarter of a million comparisons).
const MOST: usize = 512;

/// Returns the pairs (left, right) of the longest common subsequence. Among equal lengths, it
/// prefers early pairs.
#[must_use]
pub fn longest(
    left: usize,
    right: usize,
    same: impl Fn(usize, usize) -> bool,
) -> Vec<(usize, usize)> {
    let (left, right) = (left.min(MOST), right.min(MOST));
    let width = right + 1;
    // The number of pairs from (l, r) on.
    let mut pairs = vec![0_u16; (left + 1) * width];
    let at = |l: usize, r: usize| l * width + r;
    let of = |pairs: &[u16], l: usize, r: usize| pairs.get(at(l, r)).copied().unwrap_or(0);
    for l in (0..left).rev() {
        for r in (0..right).rev() {
            let best = if same(l, r) {
                of(&pairs, l + 1, r + 1) + 1
            } else {
                of(&pairs, l + 1, r).max(of(&pairs, l, r + 1))
            };
            if let Some(place) = pairs.get_mut(at(l, r)) {
                *place = best;
            }
        }
    }
    let (mut l, mut r) = (0, 0);
    let mut found = Vec::new();
    while l < left && r < right {
        if same(l, r) {
            found.push((l, r));
            l += 1;
            r += 1;
        } else if of(&pairs, l + 1, r) >= of(&pairs, l, r + 1) {
            l += 1;
        } else {
            r += 1;
        }
    }
    found
}

/// Returns the indices of `wanted` without a partner in `there`. `same` compares an index of either
/// list. A device in another place is not missing.
#[must_use]
pub fn missing(
    wanted: usize,
    there: usize,
    same: impl Fn(usize, usize) -> bool + Copy,
) -> Vec<usize> {
    let pairs = longest(wanted, there, same);
    let mut free: Vec<usize> = (0..there).collect();
    free.retain(|t| pairs.iter().all(|(_, paired)| paired != t));
    let mut missing: Vec<usize> = (0..wanted).collect();
    missing.retain(|w| pairs.iter().all(|(paired, _)| paired != w));
    missing.retain(|w| match free.iter().position(|t| same(*w, *t)) {
        Some(moved) => {
            free.remove(moved);
            false
        }
        None => true,
    });
    missing
}

/// Returns the indices of `wanted` from which a device may have moved to index `at` of `there`, so
/// that all others keep their order.
#[must_use]
pub fn moved_from(
    wanted: usize,
    there: usize,
    at: usize,
    same: impl Fn(usize, usize) -> bool,
) -> Vec<usize> {
    if wanted != there {
        return Vec::new();
    }
    let others: Vec<usize> = (0..there).filter(|t| *t != at).collect();
    let fits = |moved: &usize| {
        let mut rest = (0..wanted).filter(|w| w != moved).zip(&others);
        same(*moved, at) && rest.all(|(w, t)| same(w, *t))
    };
    (0..wanted).filter(fits).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn missing_returns_devices_without_a_partner() {
        for (there, expected) in [
            ("caab", &[][..]),
            ("cab", &[2]),
            ("ca", &[2, 3]),
            ("cb", &[1, 2]),
            ("aab", &[0]),
            ("", &[0, 1, 2, 3]),
            // Another device among them.
            ("cx", &[1, 2, 3]),
            ("caxb", &[2]),
            // In another place.
            ("acab", &[]),
            ("baac", &[]),
            ("cba", &[2]),
        ] {
            let (wanted, there) = (b"caab", there.as_bytes());
            let same = |w: usize, t: usize| wanted.get(w) == there.get(t);
            assert_eq!(missing(4, there.len(), same), expected, "{there:?}");
        }
    }

    #[test]
    fn moved_from_returns_all_places_that_fit() {
        for (wanted, there, at, expected) in [
            ("abc", "acb", 2, &[1][..]),
            ("abc", "bca", 2, &[0]),
            ("abb", "abb", 2, &[1, 2]),
            ("aaa", "aaa", 2, &[0, 1, 2]),
            ("abc", "acx", 2, &[]),
            ("abc", "ac", 1, &[]),
        ] {
            let (w, t) = (wanted.as_bytes(), there.as_bytes());
            let same = |a: usize, b: usize| w.get(a) == t.get(b);
            let found = moved_from(w.len(), t.len(), at, same);
            assert_eq!(found, expected, "{wanted} {there}");
        }
    }

    fn aligned(left: &str, right: &str) -> Vec<(usize, usize)> {
        let (l, r) = (left.as_bytes(), right.as_bytes());
        longest(l.len(), r.len(), |a, b| l.get(a) == r.get(b))
    }

    #[test]
    fn longest_returns_common_subsequences() {
        for (left, right, expected) in [
            ("", "", vec![]),
            ("abc", "abc", vec![(0, 0), (1, 1), (2, 2)]),
            ("abc", "bc", vec![(1, 0), (2, 1)]),
            ("ab", "aab", vec![(0, 0), (1, 2)]),
            ("eiei", "iei", vec![(1, 0), (2, 1), (3, 2)]),
            ("abcd", "dbca", vec![(1, 1), (2, 2)]),
            ("abc", "xyz", vec![]),
        ] {
            assert_eq!(aligned(left, right), expected, "{left} {right}");
        }
    }

    /// Length of the longest common subsequence by exhaustive search.
    fn slowly(left: &[u8], right: &[u8]) -> usize {
        match (left.split_first(), right.split_first()) {
            (Some((a, left_rest)), Some((b, right_rest))) => {
                let paired = if a == b {
                    1 + slowly(left_rest, right_rest)
                } else {
                    0
                };
                paired
                    .max(slowly(left_rest, right))
                    .max(slowly(left, right_rest))
            }
            _ => 0,
        }
    }

    proptest! {
        #[test]
        fn longest_has_maximum_length(left in "[ab]{0,7}", right in "[abc]{0,7}") {
            let pairs = aligned(&left, &right);
            prop_assert_eq!(pairs.len(), slowly(left.as_bytes(), right.as_bytes()));
            prop_assert!(pairs.is_sorted_by(|a, b| a.0 < b.0 && a.1 < b.1));
            for (l, r) in pairs {
                prop_assert_eq!(left.as_bytes()[l], right.as_bytes()[r]);
            }
        }
    }
}

//! Longest common subsequence of two lists.

/// The maximum length of a list; longer lists are not aligned (a quarter of a million comparisons).
const MOST: usize = 512;

/// Returns the pairs (left, right) of the longest common subsequence. Among equal lengths, it
/// prefers early pairs.
pub(super) fn longest(
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

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

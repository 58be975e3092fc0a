//! "Did you mean": the nearest of the names that would have been right.

/// Longest name that is compared; longer ones have no near neighbour worth naming.
const NAME_MAX: usize = 64;

/// Edits (insert, delete, replace, swap of neighbours) between two names, ignoring case.
fn distance(a: &str, b: &str) -> usize {
    let fold = |s: &str| s.chars().flat_map(char::to_lowercase).collect::<Vec<_>>();
    let (a, b) = (fold(a), fold(b));
    let mut rows = vec![(0..=b.len()).collect::<Vec<_>>()];
    for (i, x) in a.iter().enumerate() {
        let mut row = vec![i + 1];
        for (j, y) in b.iter().enumerate() {
            let mut best = (rows[i][j] + usize::from(x != y)).min(rows[i][j + 1] + 1).min(row[j] + 1);
            if i > 0 && j > 0 && *x == b[j - 1] && a[i - 1] == *y {
                best = best.min(rows[i - 1][j - 1] + 1);
            }
            row.push(best);
        }
        rows.push(row);
    }
    rows[a.len()][b.len()]
}

/// The nearest candidate, if it is near enough to be what was meant: a third of the letters may differ, or one
/// name begins with the other.
pub fn nearest<'a>(name: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    if name.is_empty() || name.len() > NAME_MAX {
        return None;
    }
    candidates
        .into_iter()
        .filter(|c| c.len() <= NAME_MAX)
        .map(|c| {
            let near = distance(name, c);
            let part = name.len() >= 3 && c.len() >= 3 && (c.starts_with(name) || name.starts_with(c));
            (if part { near.min(1) } else { near }, near, c)
        })
        .filter(|(d, _, c)| *d <= (name.chars().count().max(c.chars().count()) / 3).max(1))
        .min_by_key(|(d, near, _)| (*d, *near))
        .map(|(.., c)| c)
}

/// `did you mean 'x'? ` or nothing, followed by the whole list.
pub fn suggestion<'a>(
    name: &str,
    what: &str,
    candidates: impl IntoIterator<Item = &'a str> + Clone,
) -> String {
    let list = candidates.clone().into_iter().collect::<Vec<_>>().join(", ");
    let list = if list.is_empty() { format!("{what}: none") } else { format!("{what}: {list}") };
    match nearest(name, candidates) {
        Some(near) => format!("did you mean '{near}'?\n{list}"),
        None => list,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_nearest_name_is_found() {
        let keys = ["bus", "bitrate", "interface", "stale_after", "tcp"];
        for (typed, meant) in [
            ("bitrat", Some("bitrate")),
            ("birtate", Some("bitrate")),
            ("Interface", Some("interface")),
            ("stale", Some("stale_after")),
            ("buss", Some("bus")),
            // Both are near: fewer edits win over a common beginning.
            ("tcpp", Some("tcp")),
            ("stale_aftr", Some("stale_after")),
            ("x", None),
            ("cycle", None),
            ("", None),
        ] {
            assert_eq!(nearest(typed, keys), meant, "{typed}");
        }
    }

    proptest! {
        #[test]
        fn distance_is_symmetric_and_zero_for_the_same(a in "[a-z_]{0,12}", b in "[a-z_]{0,12}") {
            prop_assert_eq!(distance(&a, &b), distance(&b, &a));
            prop_assert_eq!(distance(&a, &b) == 0, a == b);
            prop_assert!(distance(&a, &b) <= a.len().max(b.len()));
        }
    }
}

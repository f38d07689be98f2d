//! Names that are similar to one that does not exist: for the remedies of errors. Pure.

/// Maximum number of suggested names.
pub const NEAREST_MAX: usize = 3;
/// Maximum number of compared names: one comparison takes about a microsecond.
pub const COMPARED_MAX: usize = 1_024;
/// Maximum number of compared characters of a name.
const CHARACTERS_MAX: usize = 64;
/// Similarity (Jaro-Winkler, 0 to 1) from which a name is suggested. `knee.senser` and `knee.drive` have
/// 0.77, `knee.senser` and `hip.drive` 0.53, `sink` and `sync` 0.67.
const SIMILAR: f64 = 0.66;

/// Returns up to [`NEAREST_MAX`] entries of `known` with names similar to `name`, most similar first. Each
/// name appears once.
pub fn nearest<T>(name: &str, known: impl IntoIterator<Item = T>, name_of: impl Fn(&T) -> &str) -> Vec<T> {
    let name: String = name.chars().take(CHARACTERS_MAX).collect();
    let known = known.into_iter().take(COMPARED_MAX);
    let mut similar: Vec<_> = known
        .map(|known| (strsim::jaro_winkler(&name, name_of(&known)), known))
        .filter(|(similarity, _)| *similarity >= SIMILAR)
        .collect();
    similar.sort_by(|a, b| b.0.total_cmp(&a.0).then_with(|| name_of(&a.1).cmp(name_of(&b.1))));
    similar.dedup_by(|a, b| name_of(&a.1) == name_of(&b.1));
    similar.into_iter().take(NEAREST_MAX).map(|(_, known)| known).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of<'a>(name: &str, known: &[&'a str]) -> Vec<&'a str> {
        nearest(name, known.iter().copied(), |known| known)
    }

    #[test]
    fn similar_names_are_suggested_once_and_best_first() {
        let known = ["hip.drive", "knee.drive", "knee.sensor", "knee.sensor"];
        assert_eq!(of("knee.senser", &known), ["knee.sensor", "knee.drive"]);
        assert_eq!(of("camera", &known), [""; 0]);
    }

    #[test]
    fn at_most_three_names_are_suggested() {
        assert_eq!(
            of("drive", &["drive.1", "drive.2", "drive.3", "drive.4"]),
            ["drive.1", "drive.2", "drive.3"]
        );
    }

    #[test]
    fn names_beyond_the_bounds_are_not_compared() {
        let many = vec!["other"; COMPARED_MAX];
        assert_eq!(of("knee", &[&many[..], &["knee"]].concat()), [""; 0]);
        assert_eq!(of(&"k".repeat(100_000), &["kkkk"]), ["kkkk"]);
    }
}

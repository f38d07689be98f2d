//! The group with a name that differs from a word in one character.
//!
//! Nodes know groups by their addresses, which are computed from the names. So the names that differ from the word in
//! one character are tried.

use std::collections::BTreeMap;

use sinew::AppAddress;

/// Characters that names of groups usually have.
const SIGNS: &str = "abcdefghijklmnopqrstuvwxyz0123456789._-/ABCDEFGHIJKLMNOPQRSTUVWXYZ";
/// Maximum length of a word for which names are tried, in characters: that of names of applications.
const LONGEST: usize = 63;

/// Returns a group with members, and their number, if its name differs from `word` in one character, or in the order of
/// two.
pub(super) fn nearest_group(word: &str, groups: &BTreeMap<AppAddress, u64>) -> Option<(String, u64)> {
    let signs: Vec<char> = word.chars().collect();
    if groups.is_empty() || signs.len() > LONGEST {
        return None;
    }
    let known = |name: &String| groups.get(&AppAddress::group(name)).copied();
    let tried = shorter(&signs).chain(swapped(&signs)).chain(changed(&signs)).chain(longer(&signs));
    tried.filter(|name| !name.is_empty()).find_map(|name| known(&name).map(|members| (name, members)))
}

fn shorter(signs: &[char]) -> impl Iterator<Item = String> {
    (0..signs.len()).map(|at| signs[..at].iter().chain(&signs[at + 1..]).collect())
}

fn swapped(signs: &[char]) -> impl Iterator<Item = String> {
    (1..signs.len()).map(|at| {
        let mut signs = signs.to_vec();
        signs.swap(at - 1, at);
        signs.into_iter().collect()
    })
}

fn changed(signs: &[char]) -> impl Iterator<Item = String> {
    let put = |at: usize, sign| {
        signs[..at].iter().copied().chain([sign]).chain(signs[at + 1..].iter().copied()).collect()
    };
    (0..signs.len()).flat_map(move |at| SIGNS.chars().map(move |sign| put(at, sign)))
}

fn longer(signs: &[char]) -> impl Iterator<Item = String> {
    let put = |at: usize, sign| {
        signs[..at].iter().copied().chain([sign]).chain(signs[at..].iter().copied()).collect()
    };
    (0..=signs.len()).flat_map(move |at| SIGNS.chars().map(move |sign| put(at, sign)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_wrong_character_still_finds_the_group() {
        let groups = BTreeMap::from([(AppAddress::group("pressure"), 1), (AppAddress::group("drives"), 4)]);
        let near = |word: &str| nearest_group(word, &groups);
        for word in ["presure", "pressures", "pressurE", "rpessure", "Pressure"] {
            assert_eq!(near(word), Some(("pressure".to_owned(), 1)), "{word}");
        }
        assert_eq!(near("drive"), Some(("drives".to_owned(), 4)));
        for word in ["", "pres", "temperature", &"p".repeat(100_000)] {
            assert_eq!(near(word), None, "{word}");
        }
    }
}

//! Sets of sequence numbers: 2 bytes for each, for the comparison of two long files.

use std::collections::BTreeMap;

/// A set of numbers. Those of a source are dense, so they are kept by their upper bits.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Sequences {
    pages: BTreeMap<u64, Vec<u16>>,
    count: u64,
}

impl Sequences {
    pub(crate) fn insert(&mut self, number: u64) {
        self.pages.entry(number >> 16).or_default().push(number as u16);
        self.count += 1;
    }

    /// Sorts the numbers, and removes those that are there twice. Before it, the other functions give no result.
    pub(crate) fn settle(&mut self) {
        self.count = 0;
        for page in self.pages.values_mut() {
            page.sort_unstable();
            page.dedup();
            self.count += page.len() as u64;
        }
    }

    pub(crate) const fn len(&self) -> u64 {
        self.count
    }

    pub(crate) fn first(&self) -> Option<u64> {
        let (page, numbers) = self.pages.first_key_value()?;
        Some(page << 16 | u64::from(*numbers.first()?))
    }

    pub(crate) fn last(&self) -> Option<u64> {
        let (page, numbers) = self.pages.last_key_value()?;
        Some(page << 16 | u64::from(*numbers.last()?))
    }

    /// Adds all numbers of another set.
    pub(crate) fn absorb(&mut self, other: Self) {
        for (page, mut numbers) in other.pages {
            self.pages.entry(page).or_default().append(&mut numbers);
        }
        self.count += other.count;
    }

    fn has(&self, number: u64) -> bool {
        self.pages.get(&(number >> 16)).is_some_and(|page| page.binary_search(&(number as u16)).is_ok())
    }

    /// Returns the numbers that are not in `other`, in order.
    pub(crate) fn without<'s>(&'s self, other: &'s Self) -> impl Iterator<Item = u64> + 's {
        let pages = self.pages.iter();
        let all =
            pages.flat_map(|(page, numbers)| numbers.iter().map(move |low| page << 16 | u64::from(*low)));
        all.filter(|number| !other.has(*number))
    }
}

/// Returns numbers as ranges: `3, 5-9`, at most `max` of them.
pub(crate) fn ranges(numbers: impl IntoIterator<Item = u64>, max: usize) -> String {
    let mut all: Vec<(u64, u64)> = Vec::new();
    let mut is_cut = false;
    for number in numbers {
        let count = all.len();
        match all.last_mut() {
            Some((_, last)) if last.checked_add(1) == Some(number) => *last = number,
            Some(_) if count == max => {
                is_cut = true;
                break;
            }
            Some(_) | None => all.push((number, number)),
        }
    }
    spans(&all) + if is_cut { ", ..." } else { "" }
}

/// Returns spans as text: `3, 5-9`.
pub(crate) fn spans(all: &[(u64, u64)]) -> String {
    let text = |(first, last): &(u64, u64)| {
        if first == last { first.to_string() } else { format!("{first}-{last}") }
    };
    all.iter().map(text).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_numbers_are_found_and_named() {
        let [mut sent, mut received] = [Sequences::default(), Sequences::default()];
        (1..200_000).for_each(|number| sent.insert(number));
        (1..200_000)
            .rev()
            .filter(|number| !(70_000..70_010).contains(number) && *number != 9)
            .for_each(|number| received.insert(number));
        received.insert(1);
        sent.settle();
        received.settle();
        assert_eq!((sent.len(), received.len()), (199_999, 199_988));
        assert_eq!((received.first(), received.last()), (Some(1), Some(199_999)));
        assert_eq!(ranges(sent.without(&received), 8), "9, 70000-70009");
        assert_eq!(ranges([1, 3, 5, 7], 2), "1, 3, ...");
        assert_eq!(received.without(&sent).next(), None);
    }
}

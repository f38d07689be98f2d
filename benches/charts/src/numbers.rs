//! Numbers as readers see them.

/// Microseconds with three digits.
pub(crate) fn micros(nanos: u64) -> String {
    let micros = nanos as f64 / 1_000.0;
    if micros < 10.0 {
        let text = format!("{micros:.2}");
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else if micros < 100.0 {
        format!("{micros:.1}")
    } else {
        grouped(nanos.saturating_add(500) / 1_000)
    }
}

/// A ratio with two decimal places, with one from 10 on.
pub(crate) fn ratio(of: u64, to: u64) -> String {
    let ratio = of as f64 / to as f64;
    if ratio < 10.0 { format!("{ratio:.2}") } else { format!("{ratio:.1}") }
}

/// An integer with commas.
pub(crate) fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (at, digit) in digits.chars().enumerate() {
        if at > 0 && (digits.len() - at).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_have_three_digits() {
        let shown = [130, 4_200, 7_284, 16_400, 134_700, 1_703_900].map(micros);
        assert_eq!(shown, ["0.13", "4.2", "7.28", "16.4", "135", "1,704"]);
    }

    #[test]
    fn ratios_and_integers_are_readable() {
        assert_eq!([ratio(73, 42), ratio(1_085, 100)], ["1.74", "10.8"]);
        assert_eq!([1, 999, 1_000, 1_104_829].map(grouped), ["1", "999", "1,000", "1,104,829"]);
    }
}

//! Random numbers as a value: a small seeded generator, with the same numbers for the same seed on the same
//! machine.

/// `SplitMix64` with uniform and normal draws. Not for secrets.
#[derive(Debug, Clone)]
pub struct Chance {
    state: u64,
    spare_normal: Option<f64>,
}

impl Chance {
    /// A generator that depends on nothing but `seed`.
    #[must_use]
    pub const fn from_seed(seed: u64) -> Self {
        Self { state: seed, spare_normal: None }
    }

    /// An independent generator for one purpose, so that a draw more here does not shift the numbers there.
    #[must_use]
    pub fn for_purpose(seed: u64, purpose: u64) -> Self {
        let mut mixer = Self::from_seed(seed ^ purpose.wrapping_mul(0xA076_1D64_78BD_642F));
        Self::from_seed(mixer.next_u64())
    }

    /// The next 64 random bits.
    pub fn next_u64(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.state;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform in (0, 1]; never zero, so that its logarithm is finite.
    pub fn uniform(&mut self) -> f64 {
        let mantissa = (self.next_u64() >> 11) + 1;
        mantissa as f64 * (1.0 / 9_007_199_254_740_992.0)
    }

    /// Normal with mean 0 and standard deviation 1 (Box and Muller; the second of each pair is kept).
    pub fn normal(&mut self) -> f64 {
        if let Some(spare) = self.spare_normal.take() {
            return spare;
        }
        let radius = (-2.0 * self.uniform().ln()).sqrt();
        let (sine, cosine) = (std::f64::consts::TAU * self.uniform()).sin_cos();
        self.spare_normal = Some(radius * sine);
        radius * cosine
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn same_seed_gives_same_numbers() {
        let (mut a, mut b) = (Chance::from_seed(7), Chance::from_seed(7));
        assert!((0..100).all(|_| a.normal().to_bits() == b.normal().to_bits()));
    }

    #[test]
    fn normal_has_mean_zero_and_deviation_one() {
        let mut chance = Chance::for_purpose(1, 2);
        let draws: Vec<f64> = (0..20_000).map(|_| chance.normal()).collect();
        let mean = draws.iter().sum::<f64>() / 20_000.0;
        let variance = draws.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 20_000.0;
        assert!(mean.abs() < 0.03, "mean {mean}");
        assert!((variance - 1.0).abs() < 0.05, "variance {variance}");
    }
}

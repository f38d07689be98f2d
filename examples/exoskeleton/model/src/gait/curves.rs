//! Reference curves of one gait cycle as Fourier series, with exact derivatives.
//!
//! Coefficients: mean of 53 right-leg strides of one adult (subject 15, 79.4 kg, 1.832 m) at 0.8 m/s, from
//! Moore, Hnat, van den Bogert (2015), `PeerJ` 3:e918, doi:10.7717/peerj.918; data doi:10.5281/zenodo.13030, CC0 1.0.
//! `data/gait_fourier.csv` holds the same numbers; a test compares them.

use std::f64::consts::TAU;

use crate::joint::Joint;

/// Mean duration of a stride in the recording, seconds.
pub const STRIDE_MEAN_S: f64 = 1.328;
/// Standard deviation of the stride duration in the recording, seconds.
pub const STRIDE_DEVIATION_S: f64 = 0.028;
/// Share of the cycle at which the foot leaves the ground, 0..1.
pub const TOE_OFF_PHASE: f64 = 0.665;

const HARMONICS: usize = 10;

/// `mean + sum cosine[n] cos(2 pi (n+1) x) + sine[n] sin(2 pi (n+1) x)` for the phase x in cycles.
#[derive(Debug, Clone, Copy)]
struct Series {
    mean: f64,
    cosine: [f64; HARMONICS],
    sine: [f64; HARMONICS],
}

/// Value of a curve and its first two derivatives by phase (per cycle, per cycle squared).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CurvePoint {
    /// The curve itself.
    pub value: f64,
    /// First derivative by phase, per cycle.
    pub slope: f64,
    /// Second derivative by phase, per cycle squared.
    pub curvature: f64,
}

/// Joint angle (rad) at `phase` (cycles, any real number) with its derivatives by phase.
#[must_use]
pub fn angle_rad(joint: Joint, phase: f64) -> CurvePoint {
    let series = match joint {
        Joint::Hip => &HIP_ANGLE_DEG,
        Joint::Knee => &KNEE_ANGLE_DEG,
        Joint::Ankle => &ANKLE_ANGLE_DEG,
    };
    let degrees = series.at(phase);
    CurvePoint {
        value: degrees.value.to_radians(),
        slope: degrees.slope.to_radians(),
        curvature: degrees.curvature.to_radians(),
    }
}

/// Internal (muscle) moment at `phase`, Nm per kg of body mass.
#[must_use]
pub fn moment_nm_per_kg(joint: Joint, phase: f64) -> f64 {
    let series = match joint {
        Joint::Hip => &HIP_MOMENT_NM_PER_KG,
        Joint::Knee => &KNEE_MOMENT_NM_PER_KG,
        Joint::Ankle => &ANKLE_MOMENT_NM_PER_KG,
    };
    series.at(phase).value
}

/// Vertical ground reaction under the foot at `phase`, in body weights; never negative.
#[must_use]
pub fn vertical_load_bw(phase: f64) -> f64 {
    // The truncated series rings around zero while the foot is in the air.
    if phase.rem_euclid(1.0) > TOE_OFF_PHASE + 0.015 && phase.rem_euclid(1.0) < 0.985 {
        return 0.0;
    }
    VERTICAL_LOAD_BW.at(phase).value.max(0.0)
}

impl Series {
    fn at(&self, phase: f64) -> CurvePoint {
        let (sine, cosine) = (TAU * phase).sin_cos();
        // Harmonics by rotation of a unit vector: one sine and cosine instead of ten.
        let (mut s, mut c) = (sine, cosine);
        let mut point = CurvePoint { value: self.mean, ..CurvePoint::default() };
        for (n, (a, b)) in self.cosine.iter().zip(&self.sine).enumerate() {
            let order = TAU * (n + 1) as f64;
            let wave = a * c + b * s;
            point.value += wave;
            point.slope += order * (b * c - a * s);
            point.curvature -= order * order * wave;
            (s, c) = (s * cosine + c * sine, c * cosine - s * sine);
        }
        point
    }
}

const HIP_ANGLE_DEG: Series = Series {
    mean: 12.436722,
    cosine: [
        11.9016, -2.116708, -0.532899, -0.215981, -0.398621, -0.01371, 0.039755, -0.028533, 0.01585, 0.000923,
    ],
    sine: [
        -1.601378, -1.56823, 1.335158, 0.076664, 0.181264, 0.114203, -0.068325, 0.04693, 0.028372, 0.021796,
    ],
};

const KNEE_ANGLE_DEG: Series = Series {
    mean: 21.283083,
    cosine: [
        -2.040663, -15.64444, -2.952771, -1.217906, -0.804422, -0.046342, 0.052398, 0.023617, 0.041859,
        -0.002023,
    ],
    sine: [
        -18.486552, 2.311345, 4.628152, 1.059437, 0.661242, 0.474722, 0.073778, 0.135486, 0.07629, 0.059573,
    ],
};

const ANKLE_ANGLE_DEG: Series = Series {
    mean: -6.788141,
    cosine: [
        -7.452196, 4.553027, -3.427808, -1.215609, 1.613529, 0.416823, 0.085407, 0.440715, 0.289536,
        -0.017836,
    ],
    sine: [
        5.57297, -2.518562, -3.968918, 2.067638, 0.329166, -0.435224, 0.270697, 0.314912, -0.045565,
        -0.008168,
    ],
};

const HIP_MOMENT_NM_PER_KG: Series = Series {
    mean: -0.062928,
    cosine: [
        -0.337671, 0.059293, -0.049382, 0.02589, 0.008018, -0.004624, -0.004245, -0.001522, -0.005153,
        -0.005558,
    ],
    sine: [
        -0.213792, -0.087744, -0.068702, 0.021035, 0.004931, 0.019143, 0.025309, 0.011758, 0.000263, 0.001553,
    ],
};

const KNEE_MOMENT_NM_PER_KG: Series = Series {
    mean: 0.068684,
    cosine: [
        0.016837, 0.091625, 0.038567, 0.041978, -0.004578, 0.014543, -0.002745, 0.001915, 0.003708, 0.002262,
    ],
    sine: [
        0.04955, -0.095731, 0.036131, -0.020768, 0.01706, -0.007685, -0.009862, -0.002106, -0.002887,
        -0.003257,
    ],
};

const ANKLE_MOMENT_NM_PER_KG: Series = Series {
    mean: -0.465107,
    cosine: [
        0.574809, -0.186698, 0.171882, -0.070215, 0.007853, -0.008257, -0.014461, -0.002455, -0.007179,
        -0.001507,
    ],
    sine: [
        -0.339255, 0.118772, 0.0547, -0.006986, 0.057555, -0.00729, 0.014821, 0.003281, 0.000491, 0.003121,
    ],
};

const VERTICAL_LOAD_BW: Series = Series {
    mean: 0.508462,
    cosine: [
        -0.289058, 0.040261, -0.155623, 0.001566, -0.021861, -0.007027, -0.003801, -0.00971, -0.003169,
        -0.005746,
    ],
    sine: [
        0.519372, 0.027935, 0.024747, 0.013861, -0.026958, 0.017248, -0.000935, 0.002166, 0.002673, -0.000372,
    ],
};

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gait::table::Table;

    #[test]
    fn built_in_coefficients_equal_the_data_file() {
        let text = include_str!("../../../data/gait_fourier.csv");
        let rows: Vec<Vec<&str>> =
            text.lines().filter(|l| l.starts_with("moore_s15")).map(|l| l.split(',').collect()).collect();
        let built_in = [
            ("hip_deg", &HIP_ANGLE_DEG),
            ("knee_deg", &KNEE_ANGLE_DEG),
            ("ankle_deg", &ANKLE_ANGLE_DEG),
            ("hip_nm_kg", &HIP_MOMENT_NM_PER_KG),
            ("knee_nm_kg", &KNEE_MOMENT_NM_PER_KG),
            ("ankle_nm_kg", &ANKLE_MOMENT_NM_PER_KG),
            ("grf_v", &VERTICAL_LOAD_BW),
        ];
        for (name, series) in built_in {
            let row = rows.iter().find(|r| r[1] == name).unwrap();
            let numbers: Vec<f64> = row[2..23].iter().map(|x| x.parse().unwrap()).collect();
            assert_eq!(numbers[0], series.mean, "{name}");
            for n in 0..HARMONICS {
                assert_eq!(
                    (numbers[1 + 2 * n], numbers[2 + 2 * n]),
                    (series.cosine[n], series.sine[n]),
                    "{name}"
                );
            }
        }
    }

    #[test]
    fn curves_stay_close_to_the_mean_of_the_recording() {
        let text = include_str!("../../../data/gait_reference.csv");
        let table = Table::parse(text, &["percent", "hip_deg", "knee_deg", "ankle_deg"]).unwrap();
        for row in table.rows() {
            for joint in Joint::ALL {
                let curve = angle_rad(joint, row.values[0] / 100.0).value.to_degrees();
                // 0 and 100 % of the mean curve differ by the drift of a stride; the series closes the loop.
                assert!((curve - row.values[1 + joint.index()]).abs() < 0.5, "{joint} {}", row.values[0]);
            }
        }
    }

    #[test]
    fn slope_and_curvature_are_the_derivatives_of_the_value() {
        let h = 1e-5;
        for joint in Joint::ALL {
            for phase in [0.0, 0.13, 0.5, 0.62, 0.99] {
                let (before, here, after) =
                    (angle_rad(joint, phase - h), angle_rad(joint, phase), angle_rad(joint, phase + h));
                assert!(((after.value - before.value) / (2.0 * h) - here.slope).abs() < 1e-5);
                assert!(((after.slope - before.slope) / (2.0 * h) - here.curvature).abs() < 1e-2);
            }
        }
    }

    #[test]
    fn foot_is_unloaded_in_swing_and_loaded_in_stance() {
        assert!((70..98).all(|p| vertical_load_bw(f64::from(p) / 100.0) < 0.01));
        assert!((12..55).all(|p| vertical_load_bw(f64::from(p) / 100.0) > 0.5));
    }

    #[test]
    fn ankle_gives_its_greatest_power_at_push_off() {
        let power =
            |p: f64| moment_nm_per_kg(Joint::Ankle, p) * angle_rad(Joint::Ankle, p).slope / STRIDE_MEAN_S;
        let best =
            (0..100).max_by(|a, b| power(f64::from(*a) / 100.0).total_cmp(&power(f64::from(*b) / 100.0)));
        assert!((45..=65).contains(&best.unwrap()), "{best:?}");
    }
}

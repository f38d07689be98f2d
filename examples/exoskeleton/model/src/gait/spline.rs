//! Cubic spline through samples, with first and second derivative, "not a knot" at both ends.

/// A cubic spline; outside its knots the end pieces continue.
#[derive(Debug, Clone, PartialEq)]
pub struct Spline {
    x: Vec<f64>,
    y: Vec<f64>,
    /// Second derivative at each knot.
    bend: Vec<f64>,
}

/// Value and derivatives of a spline at one place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SplinePoint {
    /// The value.
    pub value: f64,
    /// First derivative.
    pub slope: f64,
    /// Second derivative.
    pub curvature: f64,
}

impl Spline {
    /// The spline through `(x, y)`. `None` unless there are at least 4 knots, as many `y` as `x`, and `x` rises.
    #[must_use]
    pub fn through(x: Vec<f64>, y: Vec<f64>) -> Option<Self> {
        if x.len() < 4 || x.len() != y.len() || !x.windows(2).all(|w| w[1] > w[0]) {
            return None;
        }
        let bend = bends(&x, &y);
        Some(Self { x, y, bend })
    }

    /// Value and derivatives at `x`.
    #[must_use]
    pub fn at(&self, x: f64) -> SplinePoint {
        let i = self.x.partition_point(|knot| *knot <= x).clamp(1, self.x.len() - 1) - 1;
        let h = self.x[i + 1] - self.x[i];
        let (a, b) = ((self.x[i + 1] - x) / h, (x - self.x[i]) / h);
        let (m0, m1) = (self.bend[i], self.bend[i + 1]);
        SplinePoint {
            value: a * self.y[i]
                + b * self.y[i + 1]
                + ((a * a * a - a) * m0 + (b * b * b - b) * m1) * h * h / 6.0,
            slope: (self.y[i + 1] - self.y[i]) / h
                + ((1.0 - 3.0 * a * a) * m0 + (3.0 * b * b - 1.0) * m1) * h / 6.0,
            curvature: a * m0 + b * m1,
        }
    }
}

/// Second derivatives at the knots: a tridiagonal system, eliminated forward and solved backward.
fn bends(x: &[f64], y: &[f64]) -> Vec<f64> {
    let n = x.len();
    let h: Vec<f64> = x.windows(2).map(|w| w[1] - w[0]).collect();
    let rise: Vec<f64> = y.windows(2).zip(&h).map(|(w, h)| (w[1] - w[0]) / h).collect();
    let (mut below, mut diagonal, mut above) = (vec![0.0; n], vec![1.0; n], vec![0.0; n]);
    let mut right = vec![0.0; n];
    for i in 1..n - 1 {
        (below[i], diagonal[i], above[i]) = (h[i - 1], 2.0 * (h[i - 1] + h[i]), h[i]);
        right[i] = 6.0 * (rise[i] - rise[i - 1]);
    }
    // Not a knot: the third derivative is continuous across the second and the last but one knot.
    let (p, q) = (h[0], h[1]);
    diagonal[1] += p * (p + q) / q;
    above[1] -= p * p / q;
    let (p, q) = (h[n - 2], h[n - 3]);
    diagonal[n - 2] += p * (p + q) / q;
    below[n - 2] -= p * p / q;
    for i in 2..n - 1 {
        let factor = below[i] / diagonal[i - 1];
        diagonal[i] -= factor * above[i - 1];
        right[i] -= factor * right[i - 1];
    }
    let mut bend = vec![0.0; n];
    bend[n - 2] = right[n - 2] / diagonal[n - 2];
    for i in (1..n - 2).rev() {
        bend[i] = (right[i] - above[i] * bend[i + 1]) / diagonal[i];
    }
    bend[0] = bend[1] - (bend[2] - bend[1]) * h[0] / h[1];
    bend[n - 1] = bend[n - 2] + (bend[n - 2] - bend[n - 3]) * h[n - 2] / h[n - 3];
    bend
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cubic_is_reproduced_exactly_with_its_derivatives() {
        let f = |x: f64| 1.0 + x * (2.0 + x * (-3.0 + 0.5 * x));
        let x: Vec<f64> = [0.0, 0.7, 1.0, 2.5, 3.0, 4.0].to_vec();
        let spline = Spline::through(x.clone(), x.iter().map(|x| f(*x)).collect()).unwrap();
        for at in [0.1, 0.85, 1.9, 3.7] {
            let point = spline.at(at);
            assert!((point.value - f(at)).abs() < 1e-12);
            assert!((point.slope - (2.0 - 6.0 * at + 1.5 * at * at)).abs() < 1e-11);
            assert!((point.curvature - (3.0 * at - 6.0)).abs() < 1e-11);
        }
    }

    #[test]
    fn knots_that_do_not_rise_are_rejected() {
        assert!(Spline::through(vec![0.0, 1.0, 1.0, 2.0], vec![0.0; 4]).is_none());
        assert!(Spline::through(vec![0.0, 1.0, 2.0], vec![0.0; 3]).is_none());
    }
}

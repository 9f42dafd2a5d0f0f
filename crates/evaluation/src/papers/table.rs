use serde::Serialize;

/// Requirement on a figure.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Limit {
    /// At most this.
    AtMost(f64),
    /// At least this.
    AtLeast(f64),
    /// From the first to the second.
    Between(f64, f64),
    /// This, within a tolerance.
    Near {
        /// The figure.
        value: f64,
        /// Its tolerance; with few runs, three standard errors if they are more.
        tolerance: f64,
    },
}

/// Whether a figure meets its requirement.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// It does.
    Pass,
    /// It does not.
    Fail,
    /// It has none.
    Information,
}

/// A figure beside the paper's.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TableRow {
    /// Name of the curve.
    pub series: String,
    /// Abscissa on the curve.
    pub x: f64,
    /// The paper's figure, if it prints one.
    pub paper: Option<f64>,
    /// An independent implementation's figure, if there is one.
    #[serde(rename = "reference")]
    pub independent: Option<f64>,
    /// The requirement, if there is one.
    pub limit: Option<Limit>,
    /// Our figure.
    pub ours: f64,
    /// Its Monte Carlo standard error; 0 where nothing is random.
    pub standard_error: f64,
}

/// A figure from Monte Carlo runs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SampleStatistic {
    /// The figure.
    pub value: f64,
    /// Its standard error; 0 where nothing is random.
    pub standard_error: f64,
}

impl SampleStatistic {
    /// A figure in which nothing is random.
    pub fn exact(value: f64) -> Self {
        Self { value, standard_error: 0.0 }
    }
}

impl TableRow {
    /// A row with our figure alone.
    pub fn new(series: impl Into<String>, x: f64, ours: SampleStatistic) -> Self {
        let SampleStatistic { value: ours, standard_error } = ours;
        Self {
            series: series.into(),
            x,
            paper: None,
            independent: None,
            limit: None,
            ours,
            standard_error,
        }
    }

    /// With the paper's figure.
    #[must_use]
    pub fn paper(mut self, paper: f64) -> Self {
        self.paper = Some(paper);
        self
    }

    /// With the independent implementation's figure.
    #[must_use]
    pub fn independent(mut self, independent: f64) -> Self {
        self.independent = Some(independent);
        self
    }

    /// With a requirement.
    #[must_use]
    pub fn limit(mut self, limit: Limit) -> Self {
        self.limit = Some(limit);
        self
    }

    /// Whether our figure meets the requirement.
    pub fn verdict(&self) -> Verdict {
        let good = match self.limit {
            None => return Verdict::Information,
            Some(Limit::AtMost(most)) => self.ours <= most,
            Some(Limit::AtLeast(least)) => self.ours >= least,
            Some(Limit::Between(least, most)) => (least..=most).contains(&self.ours),
            Some(Limit::Near { value, tolerance }) => {
                (self.ours - value).abs() <= tolerance.max(3.0 * self.standard_error)
            }
        };
        if good { Verdict::Pass } else { Verdict::Fail }
    }
}

/// A table, or the curves of a figure.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Table {
    /// Short name, for a file.
    pub name: &'static str,
    /// What it shows.
    pub title: String,
    /// What `x` is.
    pub x: &'static str,
    /// What the figures are.
    pub y: &'static str,
    /// Its rows.
    pub rows: Vec<TableRow>,
}

impl Table {
    /// Number of rows that fail.
    pub fn failures(&self) -> usize {
        self.rows.iter().filter(|row| row.verdict() == Verdict::Fail).count()
    }
}

/// The mean of samples with its standard error; without samples it is not a number, which meets no
/// limit.
pub(crate) fn mean(samples: &[f64]) -> SampleStatistic {
    let count = samples.len() as f64;
    let mean = samples.iter().sum::<f64>() / count;
    let variance = samples.iter().map(|s| (s - mean).powi(2)).sum::<f64>() / (count - 1.0).max(1.0);
    SampleStatistic { value: mean, standard_error: (variance / count).sqrt() }
}

/// The root of the mean square of samples with its standard error.
pub(crate) fn root_mean_square(samples: &[f64]) -> SampleStatistic {
    let squares: Vec<f64> = samples.iter().map(|s| s * s).collect();
    let SampleStatistic { value: square, standard_error: error } = mean(&squares);
    let root = square.sqrt();
    // By linearisation: d(root) = d(square) / (2 root).
    let standard_error = if root > 0.0 { error / (2.0 * root) } else { 0.0 };
    SampleStatistic { value: root, standard_error }
}

/// The root of the ratio of two mean squares over the same runs, with its standard error.
pub(crate) fn root_ratio(squares: &[f64], other_squares: &[f64]) -> SampleStatistic {
    let (above, below) = (mean(squares).value, mean(other_squares).value);
    let root = (above / below).sqrt();
    // By linearisation; both means are of the same runs, so their errors are correlated.
    let off: Vec<f64> =
        squares.iter().zip(other_squares).map(|(a, b)| a / above - b / below).collect();
    SampleStatistic { value: root, standard_error: root / 2.0 * mean(&off).standard_error }
}

/// The standard deviation of samples with its standard error.
pub(crate) fn deviation(samples: &[f64]) -> SampleStatistic {
    let middle = mean(samples).value;
    let off: Vec<f64> = samples.iter().map(|s| s - middle).collect();
    root_mean_square(&off)
}

/// The share of runs in which something happened, with its standard error.
pub(crate) fn share(happened: impl Iterator<Item = bool>) -> SampleStatistic {
    let samples: Vec<f64> = happened.map(|h| f64::from(u8::from(h))).collect();
    let p = mean(&samples).value;
    let standard_error = (p * (1.0 - p) / samples.len().max(1) as f64).sqrt();
    SampleStatistic { value: p, standard_error }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn verdicts_follow_the_limits() {
        let ours = |value| SampleStatistic { value, standard_error: 0.01 };
        let row = |value, limit| TableRow::new("", 0.0, ours(value)).limit(limit).verdict();
        assert_eq!(row(0.5, Limit::AtMost(0.5)), Verdict::Pass);
        assert_eq!(row(0.6, Limit::AtMost(0.5)), Verdict::Fail);
        assert_eq!(row(0.4, Limit::AtLeast(0.5)), Verdict::Fail);
        let near = |tolerance| Limit::Near { value: 1.0, tolerance };
        assert_eq!(row(1.029, near(0.001)), Verdict::Pass);
        assert_eq!(row(1.031, near(0.001)), Verdict::Fail);
        assert_eq!(row(1.031, near(0.05)), Verdict::Pass);
        assert_eq!(
            TableRow::new("", 0.0, SampleStatistic::exact(1.0)).verdict(),
            Verdict::Information
        );
    }

    #[test]
    fn statistics_by_hand() {
        assert_eq!(mean(&[1.0, 3.0]), SampleStatistic { value: 2.0, standard_error: 1.0 });
        assert_eq!(root_mean_square(&[3.0, 3.0]).value, 3.0);
        assert_eq!(root_ratio(&[4.0, 12.0], &[1.0, 3.0]), SampleStatistic::exact(2.0));
        let SampleStatistic { value: p, standard_error: error } =
            share([true, false, false, false].into_iter());
        assert!((p - 0.25).abs() < 1e-12 && (error - (0.25_f64 * 0.75 / 4.0).sqrt()).abs() < 1e-12);
    }
}

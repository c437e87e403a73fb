//! Filters of the Dryden turbulence.

use crate::names::named_enum;

named_enum! {
    "Dryden filter"
    /// Filter of the Dryden turbulence.
    ///
    /// Both filters use the standard deviations σ and the length scales L of [`dryden`](super::dryden). With T = L/V
    /// and the airspeed V, the autocorrelation at a lag τ is
    ///
    /// | component | `first_order` | `mil_f_8785c` |
    /// | --- | --- | --- |
    /// | longitudinal (along the mean wind) | σ²·exp(−τ/T) | σ²·exp(−τ/T) |
    /// | lateral and vertical | σ²·exp(−τ/T) | σ²·exp(−τ/T)·(1 − τ/2T) |
    ///
    /// ```
    /// use aviary::physics::wind::{DrydenFilter, WindConfig, WindModel};
    ///
    /// let wind = WindConfig { filter: DrydenFilter::MilF8785c, ..WindConfig::new(WindModel::Dryden) };
    /// assert!(wind.validate().is_ok());
    /// ```
    #[derive(Default)]
    pub enum DrydenFilter {
        /// First-order noise on every axis, the paper's recursion: x ← α·x + σ·√(1 − α²)·ξ with α = exp(−dt/T).
        #[default]
        FirstOrder = "first_order",
        /// Spectra of MIL-F-8785C, §3.7.2.1: a first-order filter for the longitudinal component, and the
        /// second-order filter (1 + √3·T·s)/(1 + T·s)² for the lateral and the vertical component.
        MilF8785c = "mil_f_8785c",
    }
}

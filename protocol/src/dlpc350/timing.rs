//! How long a pattern is shown.

use super::{Register, Result};

/// Shortest gap from the end of an exposure to the next pattern, microseconds; no gap at all is possible too.
const MIN_GAP_US: u32 = 230;

/// Exposure of a pattern, and time from one pattern to the next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExposurePeriod {
    /// Light on, microseconds.
    pub exposure_us: u32,
    /// From one pattern to the next, microseconds.
    pub period_us: u32,
}

impl ExposurePeriod {
    /// Checks what the controller would refuse: an exposure below `min_exposure_us`
    /// ([`super::BitDepth::min_exposure_us`]), and one that ends 1 to 229 us before the next pattern.
    ///
    /// # Errors
    /// [`super::Dlpc350Error::Setting`] with what would work.
    pub fn check(&self, min_exposure_us: u32) -> Result<()> {
        let Self { exposure_us, period_us } = *self;
        if exposure_us < min_exposure_us {
            let reason = format!("{exposure_us} us of light; at this bit depth a pattern needs {min_exposure_us} us");
            return Err(Self::setting_error(reason));
        }
        if exposure_us > period_us {
            let reason = format!("{exposure_us} us of light do not fit into a period of {period_us} us");
            return Err(Self::setting_error(reason));
        }
        if exposure_us != period_us && period_us - exposure_us < MIN_GAP_US {
            let most = period_us.saturating_sub(MIN_GAP_US);
            let reason = format!(
                "{} us from the end of the light to the next pattern; the projector needs none or {MIN_GAP_US} us: \
                 with a period of {period_us} us give {period_us} us of light, or {most} us or less",
                period_us - exposure_us
            );
            return Err(Self::setting_error(reason));
        }
        Ok(())
    }
}

impl Register for ExposurePeriod {
    const COMMAND: u16 = 0x1A29;
    const NAME: &'static str = "exposure and period";

    fn encode(&self) -> Vec<u8> {
        [self.exposure_us.to_le_bytes(), self.period_us.to_le_bytes()].concat()
    }

    fn decode(data: &[u8]) -> Result<Self> {
        let [e0, e1, e2, e3, p0, p1, p2, p3] = Self::bytes(data)?;
        Ok(Self { exposure_us: u32::from_le_bytes([e0, e1, e2, e3]), period_us: u32::from_le_bytes([p0, p1, p2, p3]) })
    }
}

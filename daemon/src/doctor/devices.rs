//! Are the devices there, and do they run?

use super::Check;
use super::look::Look;
use crate::device::DeviceError;

const NAME: &str = "devices";

/// Judges whether all devices could be opened and set going, and stayed.
pub(super) fn check(look: &Result<Look, DeviceError>) -> Check {
    let look = match look {
        Ok(look) => look,
        Err(error @ DeviceError::Config { .. }) => {
            return Check::fail(
                NAME,
                error.to_string(),
                "correct the rig's file; gv3 devices lists what is plugged in",
            );
        }
        Err(error) => {
            let action =
                "is it plugged in and switched on, and used by nobody else? gv3 devices lists what is plugged in";
            return Check::fail(NAME, error.to_string(), action);
        }
    };
    let name = |model: &str, serial: &str| match serial {
        "" => model.to_owned(),
        serial => format!("{model} ({serial})"),
    };
    let mut found = vec![
        format!("camera {}", name(&look.camera.model, &look.camera.serial)),
        format!("projector {}", name(&look.projector.model, &look.projector.serial)),
    ];
    found.extend(look.trigger.as_ref().map(|t| format!("trigger {}", name(&t.model, &t.serial))));
    match &look.ended_by {
        Some(reason) if reason.contains("disconnected") => {
            let detail = format!("{}; while it ran: {reason}", found.join(", "));
            Check::fail(NAME, detail, "look after cables and power, then try again")
        }
        _ => Check::pass(NAME, found.join(", ")),
    }
}

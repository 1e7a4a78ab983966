"""The effects by key. To add one: a class in the file of its group and a line here."""

from data.registry import Registry

EFFECTS = Registry(
    "effect",
    {
        "floor_sink": "plants.effects.heat:FloorSink",
        "cabinet_heat": "plants.effects.heat:CabinetHeat",
        "pump_heat": "plants.effects.heat:PumpHeat",
        "guide_friction": "plants.effects.heat:GuideFriction",
        "sun": "plants.effects.heat:Sun",
        "unlisted_warm_speed": "plants.effects.heat:UnlistedWarmSpeed",
        "unlisted_coolant_speed": "plants.effects.heat:UnlistedCoolantSpeed",
        "unlisted_feed_speed": "plants.effects.heat:UnlistedFeedSpeed",
        "radiation": "plants.effects.heat:Radiation",
        "rotating_convection": "plants.effects.heat:RotatingConvection",
        "natural_convection": "plants.effects.heat:NaturalConvection",
        "draught": "plants.effects.heat:Draught",
        "stratification": "plants.effects.heat:Stratification",
        "viscosity_feedback": "plants.effects.heat:ViscosityFeedback",
        "preload_feedback": "plants.effects.heat:PreloadFeedback",
        "speed_shift": "plants.effects.recordings:SpeedShift",
        "sensor_drift": "plants.effects.recordings:SensorDrift",
        "sensor_lag": "plants.effects.recordings:SensorLag",
        "sensor_swap": "plants.effects.recordings:SensorSwap",
        "time_skew": "plants.effects.recordings:TimeSkew",
        "wrong_parameter": "plants.effects.recordings:WrongParameter",
        "motor_loss": "plants.effects.base:MotorLoss",
        "column_bending": "plants.effects.base:ColumnBending",
        "spindle_growth": "plants.effects.base:SpindleGrowth",
        "mandrel": "plants.effects.base:Mandrel",
    },
)

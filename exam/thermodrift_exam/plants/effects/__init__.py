"""The effects by key. To add one: a class in the file of its group and a line here."""

from data.registry import Registry

EFFECTS = Registry(
    "effect",
    {
        "floor_sink": "thermodrift_exam.plants.effects.heat:FloorSink",
        "cabinet_heat": "thermodrift_exam.plants.effects.heat:CabinetHeat",
        "pump_heat": "thermodrift_exam.plants.effects.heat:PumpHeat",
        "guide_friction": "thermodrift_exam.plants.effects.heat:GuideFriction",
        "sun": "thermodrift_exam.plants.effects.heat:Sun",
        "unlisted_warm_speed": "thermodrift_exam.plants.effects.heat:UnlistedWarmSpeed",
        "unlisted_coolant_speed": "thermodrift_exam.plants.effects.heat:UnlistedCoolantSpeed",
        "unlisted_feed_speed": "thermodrift_exam.plants.effects.heat:UnlistedFeedSpeed",
        "radiation": "thermodrift_exam.plants.effects.heat:Radiation",
        "rotating_convection": "thermodrift_exam.plants.effects.heat:RotatingConvection",
        "natural_convection": "thermodrift_exam.plants.effects.heat:NaturalConvection",
        "draught": "thermodrift_exam.plants.effects.heat:Draught",
        "stratification": "thermodrift_exam.plants.effects.heat:Stratification",
        "viscosity_feedback": "thermodrift_exam.plants.effects.heat:ViscosityFeedback",
        "preload_feedback": "thermodrift_exam.plants.effects.heat:PreloadFeedback",
        "speed_shift": "thermodrift_exam.plants.effects.recordings:SpeedShift",
        "sensor_drift": "thermodrift_exam.plants.effects.recordings:SensorDrift",
        "sensor_lag": "thermodrift_exam.plants.effects.recordings:SensorLag",
        "sensor_swap": "thermodrift_exam.plants.effects.recordings:SensorSwap",
        "time_skew": "thermodrift_exam.plants.effects.recordings:TimeSkew",
        "wrong_parameter": "thermodrift_exam.plants.effects.recordings:WrongParameter",
        "motor_loss": "thermodrift_exam.plants.effects.base:MotorLoss",
        "column_bending": "thermodrift_exam.plants.effects.base:ColumnBending",
        "spindle_growth": "thermodrift_exam.plants.effects.base:SpindleGrowth",
        "mandrel": "thermodrift_exam.plants.effects.base:Mandrel",
    },
)

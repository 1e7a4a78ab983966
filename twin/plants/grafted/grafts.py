"""The grafts by key. A new one: a class in its group's file and a line here."""

from data.registry import Registry

GRAFTS = Registry(
    "graft",
    {
        "cabinet_heat": "twin.plants.grafted.heats:CabinetHeat",
        "hydraulic_unit": "twin.plants.grafted.heats:HydraulicUnit",
        "floor_sink": "twin.plants.grafted.heats:FloorSink",
        "sun": "twin.plants.grafted.heats:Sun",
        "belt_loss": "twin.plants.grafted.heats:BeltLoss",
        "draught": "twin.plants.grafted.heats:Draught",
        "unlisted_warm_speed": "twin.plants.grafted.heats:UnlistedWarmSpeed",
        "speed_shift": "twin.plants.grafted.faults:SpeedShift",
        "time_skew": "twin.plants.grafted.faults:TimeSkew",
        "sensor_drift": "twin.plants.grafted.faults:SensorDrift",
        "sensor_lag": "twin.plants.grafted.faults:SensorLag",
        "sensor_bonding": "twin.plants.grafted.faults:SensorBonding",
        "sensor_swap": "twin.plants.grafted.faults:SensorSwap",
    },
)

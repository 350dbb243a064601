from .angular_rates import write_gcsv as write_gcsv
